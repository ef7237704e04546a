#pragma once

#include <vector>

#include "integral_image.hpp"
#include "terrainloop/surf.hpp"

namespace terrainloop::surf {

/// Local maxima of the Fast-Hessian response over space and scale, refined below the pixel; their orientation
/// is left 0. In scan order.
std::vector<Keypoint> detect(const IntegralImage& integral, ImageView<std::uint8_t> mask,
                             const Settings& settings);

/// Responses of one filter at every pixel, 0 where it reaches over the border.
std::vector<double> response_map(const IntegralImage& integral, int filter_size);

}  // namespace terrainloop::surf
