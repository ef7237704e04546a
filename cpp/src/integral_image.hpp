#pragma once

#include <cstddef>
#include <vector>

#include "terrainloop/image.hpp"

namespace terrainloop {

/// Sums over any upright box of an image in constant time (Viola & Jones 2001), in double precision.
class IntegralImage {
 public:
  explicit IntegralImage(ImageView<float> image)
      : rows_(image.rows), cols_(image.cols), sums_(static_cast<std::size_t>(rows_ + 1) * (cols_ + 1), 0.0) {
    for (int row = 0; row < rows_; ++row) {
      double row_sum = 0.0;
      for (int col = 0; col < cols_; ++col) {
        row_sum += image(row, col);
        sums_[index(row + 1, col + 1)] = sums_[index(row, col + 1)] + row_sum;
      }
    }
  }

  int rows() const { return rows_; }
  int cols() const { return cols_; }

  /// Sum over the pixels of rows [row0, row1) and columns [col0, col1), which must be within the image.
  double box(int row0, int col0, int row1, int col1) const {
    return sums_[index(row1, col1)] - sums_[index(row0, col1)] - sums_[index(row1, col0)] +
           sums_[index(row0, col0)];
  }

  /// Sum over the pixels above row and left of col, each in [0, rows] or [0, cols].
  double corner(int row, int col) const { return sums_[index(row, col)]; }

 private:
  std::size_t index(int row, int col) const { return static_cast<std::size_t>(row) * (cols_ + 1) + col; }

  int rows_;
  int cols_;
  std::vector<double> sums_;
};

}  // namespace terrainloop
