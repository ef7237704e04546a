#pragma once

#include "integral_image.hpp"
#include "terrainloop/surf.hpp"

namespace terrainloop::surf {

/// Dominant direction of the image around (x, y), radians in (-pi, pi] (section 4.1).
double dominant_orientation(const IntegralImage& integral, double x, double y, double scale);

/// 64 sums of Haar wavelet responses around an oriented keypoint, unit length (section 4.2).
Descriptor describe(const IntegralImage& integral, const Keypoint& keypoint);

}  // namespace terrainloop::surf
