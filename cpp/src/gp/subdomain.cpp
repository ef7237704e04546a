#include "subdomain.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "triangular.hpp"

namespace terrainloop::gp {
namespace {

constexpr int kCells = 10;          // that a subdomain predicts, along each axis
constexpr double kSingular = 1e-6;  // least pivot of a factor, as a share of the greatest
constexpr double kPinning = 0.1;    // weight of the whole axis' precision against the interval's own

/// Weights that fall smoothly from one to zero over the knots two intervals share.
Eigen::VectorXd window(const Interval& interval, int knots, int margin) {
  const double width = 2.0 * margin + 2.0;
  return Eigen::VectorXd::NullaryExpr(interval.knots(), [&](Eigen::Index k) {
    double w = 1.0;
    if (interval.first_knot > 0) w = std::min(w, (k + 1) / width);
    if (interval.last_knot < knots) w = std::min(w, (interval.knots() - k) / width);
    return w * w * (3.0 - 2.0 * w);
  });
}

}  // namespace

std::vector<Interval> cut(int cells, int margin, const std::vector<double>& covariance,
                          const Matrix& precision) {
  const int count = (cells + kCells - 1) / kCells, knots = cells + kDegree;
  std::vector<Interval> intervals(count);
  Eigen::VectorXd total = Eigen::VectorXd::Zero(knots);
  Matrix own;
  for (int i = 0; i < count; ++i) {
    Interval& interval = intervals[i];
    interval.first_cell = static_cast<int>(static_cast<long>(i) * cells / count);
    interval.last_cell = static_cast<int>(static_cast<long>(i + 1) * cells / count);
    // Cell c spans knots c + 3 .. c + 4.
    interval.first_knot = std::max(0, interval.first_cell + kDegree / 2 - margin);
    interval.last_knot = std::min(knots, interval.last_cell + kDegree / 2 + margin + 1);
    interval.share = window(interval, knots, margin);
    total.segment(interval.first_knot, interval.knots()) += interval.share;
    if (own.rows() != interval.knots()) own = inverse(toeplitz(covariance, interval.knots()));
    interval.precision =
        (1.0 - kPinning) * own + kPinning * precision.block(interval.first_knot, interval.first_knot,
                                                            interval.knots(), interval.knots());
  }
  for (Interval& interval : intervals)
    interval.share.array() /= total.segment(interval.first_knot, interval.knots()).array();
  return intervals;
}

PackedFactor::PackedFactor(const Matrix& lower) : size_(static_cast<int>(lower.rows())) {
  std::size_t count = 0;
  for (int first = 0; first < size_; first += kPanel)
    count += (size_ - first) * std::min(kPanel, size_ - first);
  values_.resize(count);
  float* values = values_.data();
  for (int first = 0; first < size_; first += kPanel) {
    const int width = std::min(kPanel, size_ - first), height = size_ - first;
    Eigen::Map<Eigen::MatrixXf>(values, height, width) =
        lower.block(first, first, height, width).cast<float>();
    values += static_cast<std::ptrdiff_t>(height) * width;
  }
}

void PackedFactor::solve(Eigen::VectorXf& x) const {
  using Panel = Eigen::Map<const Eigen::MatrixXf>;
  const float* values = values_.data();
  for (int first = 0; first < size_; first += kPanel) {
    const int width = std::min(kPanel, size_ - first), height = size_ - first, rest = height - width;
    const Panel panel(values, height, width);
    auto head = x.segment(first, width);
    panel.topRows(width).triangularView<Eigen::Lower>().solveInPlace(head);
    x.tail(rest).noalias() -= panel.bottomRows(rest) * head;
    values += static_cast<std::ptrdiff_t>(height) * width;
  }
  for (int first = (size_ - 1) / kPanel * kPanel; first >= 0; first -= kPanel) {
    const int width = std::min(kPanel, size_ - first), height = size_ - first, rest = height - width;
    values -= static_cast<std::ptrdiff_t>(height) * width;
    const Panel panel(values, height, width);
    auto head = x.segment(first, width);
    head.noalias() -= panel.bottomRows(rest).transpose() * x.tail(rest);
    panel.topRows(width).triangularView<Eigen::Lower>().transpose().solveInPlace(head);
  }
}

Subdomain::Subdomain(const Interval& rows, const Interval& cols) : rows_(&rows), cols_(&cols) {
  const int core_rows = rows.cells() + kDegree, core_cols = cols.cells() + kDegree;
  int next = 0, next_core = rows.knots() * cols.knots() - core_rows * core_cols;
  for (int row = 0; row < rows.knots(); ++row)
    for (int col = 0; col < cols.knots(); ++col) {
      const bool core = row >= rows.support() && row < rows.support() + core_rows && col >= cols.support() &&
                        col < cols.support() + core_cols;
      position_.push_back(core ? next_core++ : next++);
    }
}

void Subdomain::assemble(const Information& information, double variance, Matrix& matrix) const {
  const int rows = rows_->knots(), cols = cols_->knots();
  matrix.resize(rows * cols, rows * cols);
  Matrix pair(cols, cols);  // of two rows of knots
  for (int i = 0; i < rows; ++i)
    for (int j = i; j < rows; ++j) {
      pair = rows_->precision(j, i) / variance * cols_->precision;
      for (int right = 0; right < std::min(kSupport, cols) && j - i < kSupport; ++right) {
        const double* entries = information.at(rows_->first_knot + i, j - i, right) + cols_->first_knot;
        for (int a = 0; a < cols - right; ++a) pair(a + right, a) += entries[a];
        for (int a = 0; a < cols - right && right > 0; ++a) pair(a, a + right) += entries[a];
      }
      const int *at_i = &position_[i * cols], *at_j = &position_[j * cols];
      for (int a = 0; a < cols; ++a) {
        double *column_i = &matrix(0, at_i[a]), *column_j = &matrix(0, at_j[a]);
        for (int b = 0; b < cols; ++b) column_i[at_j[b]] = column_j[at_i[b]] = pair(b, a);
      }
    }
}

void Subdomain::factorise(const Information& information, double variance, Eigen::MatrixXf* covariance) {
  Matrix lower;
  assemble(information, variance, lower);
  const Eigen::LLT<Eigen::Ref<Matrix>> factor(lower);
  const auto pivots = lower.diagonal();
  if (factor.info() != Eigen::Success || !pivots.allFinite() ||
      pivots.minCoeff() < kSingular * pivots.maxCoeff())
    throw std::runtime_error("the equations of a subdomain are not positive definite");
  factor_ = PackedFactor(lower);
  if (covariance == nullptr) return;
  const int core = (rows_->cells() + kDegree) * (cols_->cells() + kDegree);
  Eigen::MatrixXf inverse = lower.bottomRightCorner(core, core).cast<float>().triangularView<Eigen::Lower>();
  invert_lower<float>(inverse);
  *covariance = square<float>(inverse);
}

RowMatrix Subdomain::solve(const RowMatrix& rhs) const {
  const int rows = rows_->knots(), cols = cols_->knots();
  Eigen::VectorXf x(rows * cols);
  for (int row = 0; row < rows; ++row)
    for (int col = 0; col < cols; ++col)
      x[position_[row * cols + col]] =
          static_cast<float>(rhs(rows_->first_knot + row, cols_->first_knot + col));
  factor_.solve(x);
  RowMatrix solution(rows, cols);
  for (int row = 0; row < rows; ++row)
    for (int col = 0; col < cols; ++col)
      solution(row, col) = x[position_[row * cols + col]] * rows_->share[row] * cols_->share[col];
  return solution;
}

}  // namespace terrainloop::gp
