#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "terrainloop/image.hpp"

/// SURF as published: Bay, Ess, Tuytelaars, Van Gool, "Speeded-Up Robust Features (SURF)", CVIU 110 (2008).
namespace terrainloop::surf {

struct Keypoint {
  double x;      ///< column, pixels, to a fraction of a pixel
  double y;      ///< row, pixels
  double scale;  ///< s of the publication, pixels: the sigma of the Gaussian that the filters approximate
  double orientation;  ///< angle of the direction (d col, d row), radians in (-pi, pi]
  double response;     ///< determinant of the Hessian, filters divided by their area: image units squared
  int laplacian;       ///< +1 for a dark blob on bright ground, -1 for a bright blob on dark ground
};

using Descriptor = std::array<float, 64>;

struct Settings {
  double threshold = 0.0;  ///< the response of a keypoint exceeds it; >= 0
  int octaves = 4;         ///< each doubles the sampling step and the growth of the filters; 1 ... 16
  int intervals = 4;  ///< filter sizes in an octave; 3 ... 16, as the first and last only bound the others
  std::size_t max_keypoints = std::numeric_limits<std::size_t>::max();  ///< the strongest are kept
};

struct Features {
  std::vector<Keypoint> keypoints;  ///< strongest first; equal responses by y, then x, then scale
  std::vector<Descriptor> descriptors;
};

/// Keypoints of an image and their descriptors. Keypoints are at the pixels where mask is not 0; a mask
/// without data allows all. There are no keypoints where a required filter extends over the border.
/// Throws std::invalid_argument for an image that is not finite, a mask of another shape, and impossible
/// settings.
Features extract(ImageView<float> image, ImageView<std::uint8_t> mask, const Settings& settings);

/// Response map (rows x cols) of one box filter of odd lobe size: filter_size = 9, 15, 21, ... pixels; 0
/// where the filter extends over the border. Throws std::invalid_argument for other sizes.
std::vector<double> fast_hessian(ImageView<float> image, int filter_size);

}  // namespace terrainloop::surf
