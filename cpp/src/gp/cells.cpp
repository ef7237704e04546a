#include "cells.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

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

namespace {

CellGrid bounding_grid(const double* xy, std::size_t count, double side) {
  double low[2] = {xy[0], xy[1]}, high[2] = {xy[0], xy[1]};
  for (std::size_t i = 0; i < 2 * count; ++i) {
    low[i % 2] = std::min(low[i % 2], xy[i]);
    high[i % 2] = std::max(high[i % 2], xy[i]);
  }
  const double cols = std::floor((high[0] - low[0]) / side) + 1.0;
  const double rows = std::floor((high[1] - low[1]) / side) + 1.0;
  if (!(std::max(rows, cols) <= kMostCells))
    throw std::invalid_argument("the extent must be below a million cells");
  return {low[0], low[1], side, static_cast<int>(rows), static_cast<int>(cols)};
}

/// One pass of a radix sort: the places of `order` by their keys in [0, keys), equal ones as they were.
std::vector<std::size_t> sorted(const std::vector<std::size_t>& order, const std::vector<int>& key,
                                int keys) {
  std::vector<std::size_t> next(static_cast<std::size_t>(keys) + 1, 0), result(order.size());
  for (const int k : key) ++next[k + 1];
  for (int k = 0; k < keys; ++k) next[k + 1] += next[k];
  for (const std::size_t i : order) result[next[key[i]]++] = i;
  return result;
}

}  // namespace

OccupiedCells occupied_cells(const double* xy, std::size_t count, double side) {
  const CellGrid grid = bounding_grid(xy, count, side);
  std::vector<int> row(count), col(count);
  std::vector<std::size_t> order(count);
  for (std::size_t i = 0; i < count; ++i) {
    col[i] = std::min(static_cast<int>((xy[2 * i] - grid.x) / side), grid.cols - 1);
    row[i] = std::min(static_cast<int>((xy[2 * i + 1] - grid.y) / side), grid.rows - 1);
    order[i] = i;
  }
  OccupiedCells cells{grid, {}, std::vector<std::size_t>(static_cast<std::size_t>(grid.rows) + 1, 0),
                      {},   {}, std::vector<std::size_t>(count)};
  cells.indices = sorted(sorted(order, col, grid.cols), row, grid.rows);
  for (std::size_t k = 0; k < count; ++k) {
    const std::size_t i = cells.indices[k], before = cells.indices[k == 0 ? 0 : k - 1];
    if (k == 0 || row[i] != row[before] || col[i] != col[before]) {
      cells.col.push_back(col[i]);
      cells.first.push_back(k);
      ++cells.row_first[row[i] + 1];
    }
    cells.of_point[i] = cells.col.size() - 1;
  }
  cells.first.push_back(count);
  for (int r = 0; r < grid.rows; ++r) cells.row_first[r + 1] += cells.row_first[r];
  return cells;
}

}  // namespace terrainloop::gp
