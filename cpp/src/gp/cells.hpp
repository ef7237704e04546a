#pragma once

#include <cstddef>
#include <vector>

namespace terrainloop::gp {

constexpr double kMostCells = 1e6;  ///< along an axis

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

/// The cells that hold points, row by row, and their points: memory grows with the points, not with the area.
struct OccupiedCells {
  CellGrid grid;
  std::vector<int> col;                ///< of each cell
  std::vector<std::size_t> row_first;  ///< cells of row r are row_first[r] ... row_first[r + 1] - 1
  std::vector<std::size_t> indices;    ///< points of cell c are first[c] ... first[c + 1] - 1
  std::vector<std::size_t> first;
  std::vector<std::size_t> of_point;  ///< cell of each point
};

/// Sorts points into cells that begin at their lower corner. Throws std::invalid_argument where they reach
/// over more than kMostCells.
OccupiedCells occupied_cells(const double* xy, std::size_t count, double side);

}  // namespace terrainloop::gp
