#pragma once

#include <vector>

#include "statistics.hpp"

/// Overlapping parts of a lattice, each small enough for a dense factor.
namespace terrainloop::gp {

/// One axis of a subdomain: the cells that it predicts, and the knots that it solves for.
struct Interval {
  int first_cell, last_cell;  ///< half-open
  int first_knot, last_knot;  ///< half-open
  Eigen::VectorXd share;      ///< of each knot in the solution; over all intervals they add to one
  Matrix precision;           ///< prior precision of the knots' weights for unit variance

  int cells() const { return last_cell - first_cell; }
  int knots() const { return last_knot - first_knot; }
  /// Knots whose functions are nonzero on the cells: cells() + kDegree from this one on, relative.
  int support() const { return first_cell - first_knot; }
};

/// Cuts an axis of `cells` cells into intervals whose knots reach `margin` knots beyond their cells.
///
/// `covariance` and `precision` are the prior of the whole axis. The precision used is 0.9 times the inverse
/// of the interval's own covariance, which leaves the knots outside free, plus 0.1 times the rows of
/// `precision`, which clamp them to zero: free knots halve the error of the variance.
std::vector<Interval> cut(int cells, int margin, const std::vector<double>& covariance,
                          const Matrix& precision);

/// Lower Cholesky factor in single precision, as panels of columns, the upper triangle left out.
class PackedFactor {
 public:
  PackedFactor() = default;
  explicit PackedFactor(const Matrix& lower);
  /// x = (L L')^-1 x
  void solve(Eigen::VectorXf& x) const;

 private:
  static constexpr int kPanel = 32;
  int size_ = 0;
  std::vector<float> values_;
};

/// The posterior of a subdomain's weights on its own.
class Subdomain {
 public:
  Subdomain(const Interval& rows, const Interval& cols);

  /// Factorises the subdomain's equations; throws std::runtime_error if they are not positive definite.
  /// `covariance`, if not null, becomes that of the weights of its cells, row-major, lower triangle.
  void factorise(const Information& information, double variance, Eigen::MatrixXf* covariance);
  /// Its share of the solution for a right-hand side of the whole lattice, (knots, knots).
  RowMatrix solve(const RowMatrix& rhs) const;

  const Interval& rows() const { return *rows_; }
  const Interval& cols() const { return *cols_; }

 private:
  /// matrix becomes the prior precision plus the information, both triangles.
  void assemble(const Information& information, double variance, Matrix& matrix) const;

  const Interval *rows_, *cols_;
  std::vector<int> position_;  ///< of each knot (row-major) in the factor: those of the cells come last
  PackedFactor factor_;
};

}  // namespace terrainloop::gp
