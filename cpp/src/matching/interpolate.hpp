#pragma once

#include <algorithm>
#include <cmath>

#include "terrainloop/field.hpp"

namespace terrainloop {

/// Position of a pixel of one image in another: the pixel up and left of it, and the fraction beyond that.
struct Place {
  int col, row;
  float right, down;

  Place(const Lookup& lookup, double c, double r) {
    const double x = lookup[0] * c + lookup[1] * r + lookup[2], y = lookup[3] * c + lookup[4] * r + lookup[5];
    const double left = std::floor(x), up = std::floor(y);
    // Far outside, or where it is not even a number, it matters only that it is outside.
    col = static_cast<int>(std::min(std::max(-4.0, left), 1e9));
    row = static_cast<int>(std::min(std::max(-4.0, up), 1e9));
    right = static_cast<float>(x - left);
    down = static_cast<float>(y - up);
  }
};

/// Bilinear interpolation; pixels outside the image are 0.
template <typename T>
float bilinear(const ImageView<T>& image, const Place& at) {
  const bool inside = at.row >= 0 && at.col >= 0 && at.row + 1 < image.rows && at.col + 1 < image.cols;
  const auto pixel = [&](int row, int col) {
    const bool there = inside || (row >= 0 && col >= 0 && row < image.rows && col < image.cols);
    return there ? static_cast<float>(image(row, col)) : 0.0f;
  };
  const float upper = (1 - at.right) * pixel(at.row, at.col) + at.right * pixel(at.row, at.col + 1);
  const float lower = (1 - at.right) * pixel(at.row + 1, at.col) + at.right * pixel(at.row + 1, at.col + 1);
  return (1 - at.down) * upper + at.down * lower;
}

}  // namespace terrainloop
