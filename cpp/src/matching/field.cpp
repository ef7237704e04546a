#include "terrainloop/field.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>

#include "../image_checks.hpp"
#include "interpolate.hpp"

namespace terrainloop {
namespace {

std::array<float, 4> cubic_weights(float f) {
  constexpr float a = -0.75f;
  const auto near = [](float d) { return ((a + 2) * d - (a + 3)) * d * d + 1; };
  const auto far = [](float d) { return ((a * d - 5 * a) * d + 8 * a) * d - 4 * a; };
  return {far(1 + f), near(f), near(1 - f), far(2 - f)};
}

/// Cubic interpolation of both images from sixteen pixels; those outside are 0.
std::pair<float, float> cubic(const ImageView<float>& x, const ImageView<float>& y, const Place& at) {
  const std::array<float, 4> across = cubic_weights(at.right), down = cubic_weights(at.down);
  const int top = at.row - 1, left = at.col - 1;
  float u = 0, v = 0;
  if (top >= 0 && left >= 0 && top + 4 <= x.rows && left + 4 <= x.cols) {
    for (int i = 0; i < 4; ++i) {
      const float *along_x = &x(top + i, left), *along_y = &y(top + i, left);
      float row_u = 0, row_v = 0;
      for (int j = 0; j < 4; ++j) {
        row_u += across[j] * along_x[j];
        row_v += across[j] * along_y[j];
      }
      u += down[i] * row_u;
      v += down[i] * row_v;
    }
    return {u, v};
  }
  for (int i = std::max(0, -top); i < std::min(4, x.rows - top); ++i)
    for (int j = std::max(0, -left); j < std::min(4, x.cols - left); ++j) {
      u += down[i] * across[j] * x(top + i, left + j);
      v += down[i] * across[j] * y(top + i, left + j);
    }
  return {u, v};
}

}  // namespace

void turn_field(const ImageView<float>& x, const ImageView<float>& y, const ImageView<float>& known,
                const Lookup& lookup, int rows, int cols, float* out) {
  check(x, "x");
  check(y, "y");
  check(known, "known");
  if (!same_shape(x, y) || !same_shape(x, known))
    throw std::invalid_argument("x, y and known must have one shape");
  if (rows < 0 || cols < 0) throw std::invalid_argument("rows and cols must not be negative");
  const double scale = std::hypot(lookup[0], lookup[1]);
  if (!(scale > 0.0) || !std::all_of(lookup.begin(), lookup.end(), [](double v) { return std::isfinite(v); }))
    throw std::invalid_argument("the lookup must be finite and must not collapse the image");
  const float c = static_cast<float>(lookup[0] / scale), s = static_cast<float>(lookup[1] / scale);
  const std::size_t pixels = static_cast<std::size_t>(rows) * cols;
  for (int row = 0; row < rows; ++row)
    for (int col = 0; col < cols; ++col, ++out) {
      const Place at(lookup, col, row);
      if (!(bilinear(known, at) > 0.5f)) {
        out[0] = out[pixels] = out[2 * pixels] = 0.0f;
        continue;
      }
      const auto [u, v] = cubic(x, y, at);
      out[0] = c * u - s * v;
      out[pixels] = s * u + c * v;
      out[2 * pixels] = 1.0f;
    }
}

}  // namespace terrainloop
