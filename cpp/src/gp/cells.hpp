#pragma once

#include <cstddef>
#include <vector>

namespace terrainloop::gp {

/// Square cells over the plane; cell (row, col) spans x + side * col .. x + side * (col + 1), the same along
/// y.
struct CellGrid {
  double x, y, side;  ///< metres
  int rows, cols;
};

/// Points by cell, in their original order within one.
struct SortedCells {
  std::vector<int> of_point;         ///< row * cols + col of each point, -1 off the grid
  std::vector<std::size_t> indices;  ///< those of cell c are first[c] ... first[c + 1] - 1
  std::vector<std::size_t> first;
};

/// Counting sort of points (count, 2) row-major; the grid is closed at its upper borders.
SortedCells sort_into_cells(const double* xy, std::size_t count, const CellGrid& grid);

}  // namespace terrainloop::gp
