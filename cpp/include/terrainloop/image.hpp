#pragma once

#include <cstddef>

namespace terrainloop {

/// A row-major image owned by someone else. Pixel (row, col) is a square of side 1 centred on
/// (x, y) = (col, row).
template <typename T>
struct ImageView {
  const T* data = nullptr;
  int rows = 0;
  int cols = 0;

  const T& operator()(int row, int col) const { return data[static_cast<std::size_t>(row) * cols + col]; }
};

}  // namespace terrainloop
