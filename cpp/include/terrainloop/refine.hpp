#pragma once

#include <cstdint>
#include <optional>
#include <vector>

#include "terrainloop/image.hpp"

namespace terrainloop::refine {

/// Gradients on a grid whose pixel (row, col) is at (x, y) + resolution * (col, row), metres.
struct Gradients {
  ImageView<float> x, y, variance;
  ImageView<std::uint8_t> mask;
  double origin_x, origin_y, resolution;
};

/// SE(2), source to target: a rotation by the angle of (c, s), then a translation.
struct Motion {
  double c, s, x, y;
};

struct Settings {
  int step;          ///< rows and columns of the target from one sample to the next
  int places;        ///< largest number of samples
  int steps;         ///< largest number of Gauss-Newton steps
  double tolerance;  ///< motion of the ground below which it has converged, metres
};

/// The differences of two gradient fields at N samples of the target, linearised about a motion.
struct Linearised {
  Motion motion;
  double pivot_x, pivot_y;       ///< middle of the samples, metres
  std::vector<double> ground;    ///< N x 2, metres
  std::vector<double> residual;  ///< 2 x N: target less rotated source, of the components x and y
  std::vector<double> weights;   ///< 2 x N
  std::vector<double> slopes;  ///< 2 x N: derivatives of weights times residuals by the residuals, 0 at least
  std::vector<double>
      by_motion;  ///< 2 x N x 5: x, y, rotation about the pivot, difference in slope along x and y
};

/// Refines a motion on the gradients, by Gauss-Newton with Cauchy's weights; empty if the overlap of the maps
/// is too small. Throws std::invalid_argument for images of different shapes, impossible numbers, and where
/// a masked gradient is not finite or its variance not positive.
std::optional<Linearised> settle(const Gradients& source, const Gradients& target, const Motion& motion,
                                 const Settings& settings);

}  // namespace terrainloop::refine
