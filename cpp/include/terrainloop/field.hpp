#pragma once

#include <array>

#include "terrainloop/image.hpp"

namespace terrainloop {

/// Rows of an affine map of pixels, from (column, row, 1) of the result to (column, row) of the source image.
using Lookup = std::array<double, 6>;

/// A vector field under a rotation of its pixels, the vectors rotated too; 0 outside the observed area.
///
/// x, y and the mask `known` (1 where the ground was observed, else 0) have the same shape; out receives x, y
/// and mask one after the other, each rows x cols. Vectors are interpolated by cubics (Keys 1981, a = -3/4);
/// a pixel is known where the interpolated mask exceeds 0.5. Throws std::invalid_argument for images of
/// different shapes and for a lookup that is not finite or collapses the image.
void turn_field(const ImageView<float>& x, const ImageView<float>& y, const ImageView<float>& known,
                const Lookup& lookup, int rows, int cols, float* out);

}  // namespace terrainloop
