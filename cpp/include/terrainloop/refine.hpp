#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "terrainloop/image.hpp"

namespace terrainloop::refine {

/// Gradients on a grid whose pixel (row, col) lies at (x, y) + resolution * (col, row), metres.
struct Gradients {
  ImageView<float> x, y, variance;
  ImageView<std::uint8_t> mask;
  double origin_x, origin_y, resolution;
};

/// SE(2), source to target: a turn by the angle of (c, s), then a shift.
struct Motion {
  double c, s, x, y;
};

struct Settings {
  int step;          ///< rows and columns of the target from one place to the next
  int places;        ///< looked at, at most
  int steps;         ///< of Gauss-Newton, at most
  double tolerance;  ///< motion of the ground below which it has settled, metres
};

/// The differences of two gradient fields at N places of the target, linearised about a motion.
struct Linearised {
  Motion motion;
  double pivot_x, pivot_y;       ///< middle of the places, metres
  std::vector<double> ground;    ///< N x 2, metres
  std::vector<double> residual;  ///< 2 x N: target less turned source, of the components x and y
  std::vector<double> weights;   ///< 2 x N
  std::vector<double>
      by_motion;  ///< 2 x N x 5: x, y, turn about the pivot, difference in slope along x and y
  std::vector<double> by_strain;  ///< 2 x N x 3: along x, along y, across
};

/// Settles a motion on the gradients, by Gauss-Newton with Cauchy's weights; nothing where the maps share too
/// little ground.
std::optional<Linearised> settle(const Gradients& source, const Gradients& target, const Motion& motion,
                                 const Settings& settings);

}  // namespace terrainloop::refine
