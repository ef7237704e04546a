#pragma once

#include <array>
#include <vector>

#include "subdomain.hpp"

/// Sums of B-splines, times weights or their covariance, at queries that form a grid.
namespace terrainloop::gp {

/// One coordinate of the queries.
struct Sample {
  int cell;   ///< of the lattice
  int index;  ///< in the output
  Basis basis;
  std::array<float, kSupport * kSupport> values, slopes;  ///< products of pairs, by the first and the offset
};

/// The query at t within [0, 1] of a cell.
Sample sample_at(int cell, double t, int index);

struct Span {
  const Sample *begin_, *end_;
  const Sample* begin() const { return begin_; }
  const Sample* end() const { return end_; }
};

/// Elevation and gradient of a spline with the given weights at all rows x cols.
void evaluate_mean(const RowMatrix& weights, double spacing, Span rows, Span cols, const Maps& maps,
                   int stride);

/// Variances of the spline on the cells of a subdomain.
class VarianceField {
 public:
  /// From the result of Subdomain::factorise; variances are at least `smallest`, metres squared.
  VarianceField(const Eigen::MatrixXf& covariance, const Subdomain& subdomain, double spacing,
                double smallest);
  void evaluate(Span rows, Span cols, const Maps& maps, int stride) const;

 private:
  const Subdomain& subdomain_;
  double spacing_, smallest_;
  int rows_, cols_;
  std::vector<float> folded_;  ///< by (row, row offset, col, col offset): covariances that share a product
};

}  // namespace terrainloop::gp
