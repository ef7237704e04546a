#include <Eigen/Dense>
#include <algorithm>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "cells.hpp"
#include "checks.hpp"
#include "terrainloop/gp.hpp"
#include "thread_pool.hpp"

namespace terrainloop::gp {
namespace {

constexpr int kPatches = 2;         // to a side of a cell: points of one patch share their error
constexpr std::size_t kFewest = 8;  // points needed to estimate the scatter in a cell
constexpr double kEnough = 0.2;     // share of the points in such cells, below which the noise stays constant
constexpr int kRefits = 3;
constexpr double kPooling = 2.0;   // standard deviation of the weights of neighbouring cells, in cells
constexpr int kFarthest = 6;       // cells that are pooled, on each side
constexpr double kSmallest = 0.3;  // of the typical noise: no ground is measured much better than the rest
constexpr double kLargest = 1e50;  // bound that keeps the ratio finite
constexpr double kOutlier = 3.0;   // standard deviations from which a point counts as an outlier

double median(std::vector<double>& values) {
  const auto middle = values.begin() + values.size() / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

/// Distances of some points from the plane through most of them, and their robust standard deviation.
double scatter(const double* xy, const double* elevation, const std::size_t* begin, const std::size_t* end,
               double side, double* residuals) {
  const auto count = static_cast<std::size_t>(end - begin);
  std::vector<double> weight(count, 1.0), distance(count);
  double deviation = 0.0;
  for (int refit = 0; refit < kRefits; ++refit) {
    Eigen::Matrix3d normal = 1e-9 * Eigen::Matrix3d::Identity();
    Eigen::Vector3d right = Eigen::Vector3d::Zero();
    const auto row = [&](std::size_t k) {
      const std::size_t i = begin[k];
      return Eigen::Vector3d(1.0, (xy[2 * i] - xy[2 * begin[0]]) / side,
                             (xy[2 * i + 1] - xy[2 * begin[0] + 1]) / side);
    };
    for (std::size_t k = 0; k < count; ++k) {
      const Eigen::Vector3d x = row(k);
      normal.noalias() += weight[k] * x * x.transpose();
      right += weight[k] * elevation[begin[k]] * x;
    }
    const Eigen::Vector3d plane = normal.ldlt().solve(right);
    for (std::size_t k = 0; k < count; ++k) {
      residuals[begin[k]] = elevation[begin[k]] - row(k).dot(plane);
      distance[k] = std::abs(residuals[begin[k]]);
    }
    deviation = 1.4826 * median(distance);
    for (std::size_t k = 0; k < count; ++k)  // Cauchy weights
      weight[k] = 1.0 / (1.0 + std::pow(residuals[begin[k]] / (2.0 * deviation + 1e-9), 2));
  }
  return deviation * std::sqrt(count / (count - 3.0));
}

/// The scatter in each cell, 0 where it is not known.
struct Scatter {
  std::vector<double> variance, known;  ///< known is 1 or 0
  std::vector<double> residuals;        ///< of each point
};

Scatter measure_scatter(const double* xy, const double* elevation, const OccupiedCells& cells,
                        ThreadPool& workers) {
  const std::size_t count = cells.col.size();
  Scatter found{std::vector<double>(count, 0.0), std::vector<double>(count, 0.0),
                std::vector<double>(cells.indices.size(), 0.0)};
  workers.run(cells.grid.rows, [&](int row) {
    for (std::size_t c = cells.row_first[row]; c < cells.row_first[row + 1]; ++c) {
      const std::size_t *begin = cells.indices.data() + cells.first[c],
                        *end = cells.indices.data() + cells.first[c + 1];
      if (static_cast<std::size_t>(end - begin) < kFewest) continue;
      const double deviation = scatter(xy, elevation, begin, end, cells.grid.side, found.residuals.data());
      found.variance[c] = deviation * deviation;
      found.known[c] = 1.0;
    }
  });
  return found;
}

/// Standard deviations from the weighted mean of the variances around each cell of a row; 0 where none is
/// known.
void pool_row(const OccupiedCells& cells, int row, const Scatter& scatter, std::vector<double>& deviation) {
  std::array<double, kFarthest + 1> weights;
  for (int d = 0; d <= kFarthest; ++d) weights[d] = std::exp(-0.5 * d * d / (kPooling * kPooling));
  const int lowest = std::max(0, row - kFarthest), highest = std::min(cells.grid.rows - 1, row + kFarthest);
  std::array<std::size_t, 2 * kFarthest + 1> last;  // one past those of the row that are within reach
  for (int r = lowest; r <= highest; ++r) last[r - lowest] = cells.row_first[r];
  for (std::size_t c = cells.row_first[row]; c < cells.row_first[row + 1]; ++c) {
    const int col = cells.col[c];
    double variance = 0.0, known = 0.0;
    for (int r = highest; r >= lowest; --r) {
      std::size_t& end = last[r - lowest];
      while (end < cells.row_first[r + 1] && cells.col[end] <= col + kFarthest) ++end;
      double along = 0.0, known_along = 0.0;
      for (std::size_t k = end; k > cells.row_first[r] && cells.col[k - 1] >= col - kFarthest; --k) {
        const double by = weights[std::abs(cells.col[k - 1] - col)];
        along += by * scatter.variance[k - 1];
        known_along += by * scatter.known[k - 1];
      }
      variance += weights[std::abs(r - row)] * along;
      known += weights[std::abs(r - row)] * known_along;
    }
    deviation[c] = known > 0.0 ? std::sqrt(variance / known) : 0.0;
  }
}

/// The number of points in the patch of each point: a cell is kPatches x kPatches of them.
std::vector<int> crowding(const double* xy, const OccupiedCells& cells) {
  const CellGrid& grid = cells.grid;
  const auto within = [&grid](double from_corner) {
    const double at = from_corner / grid.side;
    return static_cast<int>(kPatches * (at - std::floor(at)));
  };
  std::vector<int> crowd(cells.col.size() * kPatches * kPatches, 0), patch(cells.indices.size());
  for (std::size_t i = 0; i < patch.size(); ++i) {
    patch[i] = within(xy[2 * i + 1] - grid.y) * kPatches + within(xy[2 * i] - grid.x);
    ++crowd[cells.of_point[i] * kPatches * kPatches + patch[i]];
  }
  for (std::size_t i = 0; i < patch.size(); ++i)
    patch[i] = crowd[cells.of_point[i] * kPatches * kPatches + patch[i]];
  return patch;
}

}  // namespace

void noise_ratio(const double* xy, const double* elevation, std::size_t count, double cell,
                 double smallest_scatter, double* ratio, int threads) {
  if (!positive(cell)) throw std::invalid_argument("the cell size must be positive");
  if (!(smallest_scatter >= 0.0)) throw std::invalid_argument("the smallest scatter must not be negative");
  check_threads(threads);
  check_positions(xy, elevation, count);
  const OccupiedCells cells = occupied_cells(xy, count, cell);
  ThreadPool workers(threads);
  const Scatter scatter = measure_scatter(xy, elevation, cells, workers);
  std::vector<double> deviation(cells.col.size());
  workers.run(cells.grid.rows, [&](int row) { pool_row(cells, row, scatter, deviation); });
  const std::vector<int> crowd = crowding(xy, cells);
  for (std::size_t i = 0; i < count; ++i) ratio[i] = std::sqrt(crowd[i]);
  std::vector<double> told;
  for (std::size_t i = 0; i < count; ++i)
    if (scatter.known[cells.of_point[i]] > 0.0) told.push_back(deviation[cells.of_point[i]]);
  if (told.size() < kEnough * count) return;
  const double typical = std::max(median(told), smallest_scatter);
  if (!(typical > 0.0)) return;
  for (std::size_t i = 0; i < count; ++i) {
    const double here = deviation[cells.of_point[i]];
    if (here <= 0.0) continue;
    const double smallest = std::max(here, kSmallest * typical);
    const double excess = std::max(1.0, std::abs(scatter.residuals[i]) / (kOutlier * smallest));
    ratio[i] *= std::min(smallest / typical * excess * excess, kLargest);
  }
}

}  // namespace terrainloop::gp
