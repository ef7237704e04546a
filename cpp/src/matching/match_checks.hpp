#pragma once

#include "terrainloop/match.hpp"

namespace terrainloop::matching {

/// Throws std::invalid_argument, naming the map, where its images or numbers make no gradient map.
void check_map(const GradientMapView& map, const char* name);

/// Throws std::invalid_argument for settings that are impossible.
void check_settings(const MatchSettings& settings);

}  // namespace terrainloop::matching
