#pragma once

#include <cmath>
#include <stdexcept>

#include "terrainloop/gp.hpp"

/// Checks that all public functions share.
namespace terrainloop::gp {

inline bool positive(double value) { return value > 0.0 && std::isfinite(value); }

inline void check_threads(int threads) {
  if (threads < 1) throw std::invalid_argument("threads must be >= 1");
}

/// Coordinates are bounded so that their squares are finite, too.
inline void check_positions(const double* xy, const double* elevation, std::size_t count) {
  const auto bounded = [](double coordinate) { return std::abs(coordinate) < 1e100; };
  if (count == 0) throw std::invalid_argument("there must be at least one point");
  for (std::size_t i = 0; i < count; ++i)
    if (!bounded(xy[2 * i]) || !bounded(xy[2 * i + 1]) || !bounded(elevation[i]))
      throw std::invalid_argument("points must be finite and below 1e100 m");
}

inline void check_points(const Points& points) {
  check_positions(points.xy, points.elevation, points.count);
  for (std::size_t i = 0; i < points.count; ++i)
    if (!positive(points.noise[i])) throw std::invalid_argument("noise must be positive");
}

}  // namespace terrainloop::gp
