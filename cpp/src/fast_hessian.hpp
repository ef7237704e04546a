#pragma once

#include <vector>

#include "terrainloop/integral_image.hpp"
#include "terrainloop/surf.hpp"

namespace terrainloop::surf {

/// Local maxima of the Fast-Hessian response over space and scale, refined below the pixel; their orientation
/// is left 0. In scan order.
std::vector<Keypoint> detect(const IntegralImage& integral, ImageView<std::uint8_t> mask,
                             const Settings& settings);

}  // namespace terrainloop::surf
