#pragma once

#include <cmath>
#include <stdexcept>

#include "terrainloop/gp.hpp"

/// What every public function refuses.
namespace terrainloop::gp {

inline bool positive(double value) { return value > 0.0 && std::isfinite(value); }

inline void check_threads(int threads) {
  if (threads < 1) throw std::invalid_argument("threads must be >= 1");
}

inline void check_positions(const double* xy, const double* elevation, std::size_t count) {
  if (count == 0) throw std::invalid_argument("there must be at least one point");
  for (std::size_t i = 0; i < count; ++i)
    if (!std::isfinite(xy[2 * i]) || !std::isfinite(xy[2 * i + 1]) || !std::isfinite(elevation[i]))
      throw std::invalid_argument("points must be finite");
}

inline void check_points(const Points& points) {
  check_positions(points.xy, points.elevation, points.count);
  for (std::size_t i = 0; i < points.count; ++i)
    if (!positive(points.noise[i])) throw std::invalid_argument("noise must be positive");
}

}  // namespace terrainloop::gp
