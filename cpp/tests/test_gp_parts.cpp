#include <gtest/gtest.h>

#include <cmath>
#include <random>
#include <vector>

#include "gp/subdomain.hpp"

namespace terrainloop::gp {
namespace {

double sum(const BasisRow& row) {
  double total = 0.0;
  for (double value : row) total += value;
  return total;
}

TEST(BSpline, FunctionsSumToOneAndTheirSlopesToZero) {
  for (double t : {0.0, 0.1, 0.37, 0.5, 0.99, 1.0}) {
    const Basis basis = basis_at(t);
    EXPECT_NEAR(sum(basis.value), 1.0, 1e-14);
    EXPECT_NEAR(sum(basis.slope), 0.0, 1e-13);
  }
}

TEST(BSpline, ValuesAtAKnotAreTheKnownOnes) {
  const double expected[] = {1.0, 120.0, 1191.0, 2416.0, 1191.0, 120.0, 1.0, 0.0};
  const Basis left = basis_at(0.0), right = basis_at(1.0);
  for (int k = 0; k < kSupport; ++k) {
    EXPECT_NEAR(left.value[k], expected[k] / 5040.0, 1e-15);
    EXPECT_NEAR(right.value[k], expected[kSupport - 1 - k] / 5040.0, 1e-14);
  }
}

TEST(BSpline, SlopesAreThoseOfTheValues) {
  constexpr double kStep = 1e-5;
  for (double t : {0.05, 0.4, 0.9}) {
    const Basis before = basis_at(t - kStep), after = basis_at(t + kStep), basis = basis_at(t);
    for (int k = 0; k < kSupport; ++k)
      EXPECT_NEAR(basis.slope[k], (after.value[k] - before.value[k]) / (2.0 * kStep), 1e-9);
  }
}

TEST(Prior, SplineHasTheCovarianceOfTheKernelAtTheKnots) {
  const std::vector<double> covariance = weight_covariance(40);
  const BasisRow at_knot = basis_at(0.0).value;
  for (int lag = 0; lag < 30; ++lag) {
    double of_spline = 0.0;
    for (int a = 0; a < kDegree; ++a)
      for (int b = 0; b < kDegree; ++b)
        of_spline += at_knot[a] * at_knot[b] * covariance[std::abs(lag + a - b)];
    const double distance = lag * kKnotSpacing;
    EXPECT_NEAR(of_spline, std::exp(-0.5 * distance * distance), 1e-9) << "lag " << lag;
  }
}

TEST(Cut, CellsAreDealtOutAndSharesAddToOne) {
  for (int cells : {1, 9, 10, 11, 37, 200})
    for (int margin : {4, 7}) {
      const int knots = cells + kDegree;
      const std::vector<double> covariance = weight_covariance(knots);
      const std::vector<Interval> intervals =
          cut(cells, margin, covariance, inverse(toeplitz(covariance, knots)));
      Eigen::VectorXd total = Eigen::VectorXd::Zero(knots);
      int next = 0;
      for (const Interval& interval : intervals) {
        EXPECT_EQ(interval.first_cell, next);
        next = interval.last_cell;
        EXPECT_GE(interval.support(), 0);
        EXPECT_LE(interval.support() + interval.cells() + kDegree, interval.knots());
        EXPECT_GE(interval.share.minCoeff(), 0.0);
        total.segment(interval.first_knot, interval.knots()) += interval.share;
      }
      EXPECT_EQ(next, cells);
      EXPECT_LT((total.array() - 1.0).abs().maxCoeff(), 1e-14) << cells << " cells, margin " << margin;
    }
}

TEST(PackedFactor, SolvesWhatItWasMadeOf) {
  std::mt19937 engine(5);
  std::normal_distribution<double> normal;
  for (int size : {1, 31, 32, 33, 100}) {
    const Matrix root = Matrix::NullaryExpr(size, size, [&] { return normal(engine); });
    const Matrix matrix = root * root.transpose() / size + Matrix::Identity(size, size);
    const Eigen::VectorXd rhs = Eigen::VectorXd::NullaryExpr(size, [&] { return normal(engine); });
    Eigen::VectorXf x = rhs.cast<float>();
    PackedFactor(matrix.llt().matrixL()).solve(x);
    EXPECT_LT((matrix * x.cast<double>() - rhs).norm(), 1e-5 * rhs.norm()) << "size " << size;
  }
}

TEST(Information, IsThatOfTheDenseDesignMatrix) {
  const Lattice lattice{-1.0, 2.0, 0.5, 12, 9};
  std::mt19937 engine(3);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  std::vector<double> xy, elevation, noise;
  const auto add = [&](double x, double y) {
    xy.insert(xy.end(), {x, y});
    elevation.push_back(uniform(engine) - 0.5);
    noise.push_back(0.1 + uniform(engine));
  };
  for (int i = 0; i < 200; ++i) add(-1.0 + 4.5 * uniform(engine), 2.0 + 6.0 * uniform(engine));
  add(-1.0, 2.0);  // the corners of the lattice belong to it
  add(3.5, 8.0);
  const Eigen::Index count = static_cast<Eigen::Index>(elevation.size());
  add(3.6, 5.0);  // outside

  Matrix design = Matrix::Zero(count, lattice.knot_rows() * lattice.knot_cols());
  for (Eigen::Index i = 0; i < count; ++i) {
    const double u = (xy[2 * i] + 1.0) / 0.5, v = (xy[2 * i + 1] - 2.0) / 0.5;
    const int col = std::min(static_cast<int>(u), 8), row = std::min(static_cast<int>(v), 11);
    const BasisRow in_x = basis_at(u - col).value, in_y = basis_at(v - row).value;
    for (int a = 0; a < kSupport; ++a)
      for (int b = 0; b < kSupport; ++b)
        design(i, (row + a) * lattice.knot_cols() + col + b) = in_y[a] * in_x[b];
  }
  const Eigen::VectorXd weight = Eigen::Map<const Eigen::ArrayXd>(noise.data(), count).square().inverse();
  const Eigen::VectorXd z = Eigen::Map<const Eigen::VectorXd>(elevation.data(), count);

  ThreadPool workers(2);
  const BinnedPoints binned = bin({xy.data(), elevation.data(), noise.data(), elevation.size()}, lattice);
  EXPECT_EQ(binned.points.size(), static_cast<std::size_t>(count));
  const Information information(binned, lattice, workers);
  const auto flat = [](const RowMatrix& m) { return Eigen::Map<const Eigen::VectorXd>(m.data(), m.size()); };
  const Eigen::VectorXd vector = design.transpose() * weight.cwiseProduct(z);
  EXPECT_LT((flat(information.vector()) - vector).cwiseAbs().maxCoeff(), 1e-12 * vector.norm());

  const RowMatrix w =
      RowMatrix::NullaryExpr(lattice.knot_rows(), lattice.knot_cols(), [&] { return uniform(engine) - 0.5; });
  RowMatrix product = RowMatrix::Ones(lattice.knot_rows(), lattice.knot_cols());
  information.add_product(w, product, workers);
  const Eigen::VectorXd expected = design.transpose() * weight.cwiseProduct(design * flat(w));
  EXPECT_LT((flat(product).array() - 1.0 - expected.array()).abs().maxCoeff(), 1e-12 * expected.norm());
}

}  // namespace
}  // namespace terrainloop::gp
