#include "cells.hpp"

#include <algorithm>

namespace terrainloop::gp {

SortedCells sort_into_cells(const double* xy, std::size_t count, const CellGrid& grid) {
  SortedCells cells{std::vector<int>(count), {}, {}};
  cells.first.assign(static_cast<std::size_t>(grid.rows) * grid.cols + 1, 0);
  for (std::size_t i = 0; i < count; ++i) {
    const double u = (xy[2 * i] - grid.x) / grid.side, v = (xy[2 * i + 1] - grid.y) / grid.side;
    const bool inside = u >= 0.0 && v >= 0.0 && u <= grid.cols && v <= grid.rows;
    cells.of_point[i] = -1;
    if (!inside) continue;
    cells.of_point[i] = std::min(static_cast<int>(v), grid.rows - 1) * grid.cols +
                        std::min(static_cast<int>(u), grid.cols - 1);
    ++cells.first[cells.of_point[i] + 1];
  }
  for (std::size_t c = 1; c < cells.first.size(); ++c) cells.first[c] += cells.first[c - 1];
  std::vector<std::size_t> next(cells.first.begin(), cells.first.end() - 1);
  cells.indices.resize(cells.first.back());
  for (std::size_t i = 0; i < count; ++i)
    if (cells.of_point[i] >= 0) cells.indices[next[cells.of_point[i]]++] = i;
  return cells;
}

}  // namespace terrainloop::gp
