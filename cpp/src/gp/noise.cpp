#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "cells.hpp"
#include "terrainloop/gp.hpp"
#include "workers.hpp"

namespace terrainloop::gp {
namespace {

constexpr int kPatches = 2;         // to a side of a cell: points of one patch share their error
constexpr std::size_t kFewest = 8;  // points that tell the scatter in a cell
constexpr double kEnough = 0.2;     // share of the points in such cells, below which the noise stays constant
constexpr int kRefits = 3;
constexpr double kPooling = 2.0;   // standard deviation of the weights of neighbouring cells, in cells
constexpr int kFarthest = 6;       // cells that are pooled, on each side
constexpr double kSmallest = 0.3;  // of the typical noise: no ground is known much better than the rest
constexpr double kOutlier = 3.0;   // standard deviations from which a point counts as an outlier

double median(std::vector<double>& values) {
  const auto middle = values.begin() + values.size() / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

CellGrid cells_over(const double* xy, std::size_t count, double side) {
  double low[2] = {xy[0], xy[1]}, high[2] = {xy[0], xy[1]};
  for (std::size_t i = 0; i < 2 * count; ++i) {
    low[i % 2] = std::min(low[i % 2], xy[i]);
    high[i % 2] = std::max(high[i % 2], xy[i]);
  }
  const double cols = std::floor((high[0] - low[0]) / side) + 1.0;
  const double rows = std::floor((high[1] - low[1]) / side) + 1.0;
  if (!(rows * cols < 1e7)) throw std::invalid_argument("the extent must be below ten million cells");
  return {low[0], low[1], side, static_cast<int>(rows), static_cast<int>(cols)};
}

/// Distances of some points from the plane that most of them lie on, and their robust standard deviation.
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

/// Weighted mean of the variances of neighbouring cells; 0 where none is known.
Eigen::ArrayXXd pool(const Eigen::ArrayXXd& variance, const Eigen::ArrayXXd& known) {
  const auto smooth = [](const Eigen::ArrayXXd& image) {
    Eigen::ArrayXXd along = Eigen::ArrayXXd::Zero(image.rows(), image.cols()), both = along;
    for (int d = -kFarthest; d <= kFarthest; ++d) {
      const double weight = std::exp(-0.5 * d * d / (kPooling * kPooling));
      const Eigen::Index rows = image.rows() - std::abs(d);
      if (rows > 0)
        along.middleRows(std::max(0, d), rows) += weight * image.middleRows(std::max(0, -d), rows);
    }
    for (int d = -kFarthest; d <= kFarthest; ++d) {
      const double weight = std::exp(-0.5 * d * d / (kPooling * kPooling));
      const Eigen::Index cols = image.cols() - std::abs(d);
      if (cols > 0) both.middleCols(std::max(0, d), cols) += weight * along.middleCols(std::max(0, -d), cols);
    }
    return both;
  };
  return smooth(variance * known) / smooth(known).max(1e-300);
}

}  // namespace

void noise_ratio(const double* xy, const double* elevation, std::size_t count, double cell,
                 double smallest_scatter, double* ratio, int threads) {
  if (!(cell > 0.0) || count == 0)
    throw std::invalid_argument("there must be points and a positive cell size");
  const CellGrid grid = cells_over(xy, count, cell);
  const SortedCells cells = sort_into_cells(xy, count, grid);
  Eigen::ArrayXXd variance = Eigen::ArrayXXd::Zero(grid.cols, grid.rows), known = variance;
  std::vector<double> residuals(count, 0.0);
  Workers workers(threads);
  workers.run(grid.rows, [&](int row) {
    for (int col = 0; col < grid.cols; ++col) {
      const std::size_t c = static_cast<std::size_t>(row) * grid.cols + col;
      if (cells.first[c + 1] - cells.first[c] < kFewest) continue;
      const double deviation = scatter(xy, elevation, &cells.indices[cells.first[c]],
                                       &cells.indices[0] + cells.first[c + 1], cell, residuals.data());
      variance(col, row) = deviation * deviation;
      known(col, row) = 1.0;
    }
  });
  const Eigen::ArrayXXd deviation = pool(variance, known).sqrt();
  std::vector<double> told;
  for (std::size_t i = 0; i < count; ++i)
    if (known(cells.of_point[i]) > 0.0) told.push_back(deviation(cells.of_point[i]));
  const SortedCells patches = sort_into_cells(xy, count, cells_over(xy, count, cell / kPatches));
  for (std::size_t i = 0; i < count; ++i)
    ratio[i] = std::sqrt(patches.first[patches.of_point[i] + 1] - patches.first[patches.of_point[i]]);
  if (told.size() < kEnough * count) return;
  const double typical = std::max(median(told), smallest_scatter);
  if (!(typical > 0.0)) return;
  for (std::size_t i = 0; i < count; ++i) {
    const double here = deviation(cells.of_point[i]);
    if (here <= 0.0) continue;
    const double smallest = std::max(here, kSmallest * typical);
    const double excess = std::max(1.0, std::abs(residuals[i]) / (kOutlier * smallest));
    ratio[i] *= smallest / typical * excess * excess;
  }
}

}  // namespace terrainloop::gp
