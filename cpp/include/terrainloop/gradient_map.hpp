#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "terrainloop/gp.hpp"
#include "terrainloop/image.hpp"

namespace terrainloop {

/// A gradient map owned by someone else: images of one shape, rows along y and columns along x, whose pixel
/// (row, col) lies at origin + resolution * (col, row). All numbers are finite, also outside the mask.
struct GradientMapView {
  ImageView<float> elevation;               ///< metres
  ImageView<float> gradient_x, gradient_y;  ///< slope along x and y
  ImageView<float> gradient_variance;       ///< of one component of the gradient; > 0 in the mask
  ImageView<std::uint8_t> mask;             ///< 1 where the ground was observed, else 0
  double origin_x, origin_y, resolution;    ///< metres
  double length_scale;                      ///< of the Gaussian process that made the map, metres
};

/// A gradient map that owns its images, row-major (rows, cols).
struct GradientMap {
  int rows, cols;
  std::vector<float> elevation, gradient_x, gradient_y;
  std::vector<float> variance, gradient_variance;  ///< of the elevation (m^2) and of one gradient component
  std::vector<std::uint8_t> mask;
  double origin_x, origin_y, resolution, length_scale;

  GradientMapView view() const;
};

struct MapSettings {
  gp::Hyperparameters parameters;
  double noise;                      ///< standard deviation of a typical point's elevation, metres
  double resolution = 0.0;           ///< metres per pixel; 0 for a sixth of the length scale
  double max_variance_ratio = 0.25;  ///< ground is observed below this share of the prior's variance
  int threads = 1;                   ///< at most; the result does not depend on it
};

/// The gradient map of a gravity-aligned cloud, `xyz` (count, 3) row-major in metres, over its bounding box.
///
/// As GradientMap.from_points in Python with the hyperparameters given: a robust plane is subtracted and its
/// slope added afterwards, and the noise is scaled by noise_ratio. The cloud is not cleaned: repeated points
/// and stray ones far from the others are for the caller to remove. Throws std::invalid_argument for points
/// and numbers that make no map or one of more than 20 million pixels, std::runtime_error where the
/// equations cannot be solved.
GradientMap make_gradient_map(const double* xyz, std::size_t count, const MapSettings& settings);

}  // namespace terrainloop
