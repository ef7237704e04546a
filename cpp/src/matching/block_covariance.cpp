#include "block_covariance.hpp"

#include <cmath>
#include <limits>
#include <map>
#include <utility>

namespace terrainloop::matching {
namespace {

constexpr double kMaxCondition = 1e10;  // of a normal matrix scaled to unit diagonal

double condition(const MatrixXd& symmetric) {
  const VectorXd sizes =
      Eigen::SelfAdjointEigenSolver<MatrixXd>(symmetric, Eigen::EigenvaluesOnly).eigenvalues().cwiseAbs();
  return sizes.minCoeff() > 0.0 ? sizes.maxCoeff() / sizes.minCoeff()
                                : std::numeric_limits<double>::infinity();
}

/// The gradient of the fit summed over each block, one a row.
MatrixXd block_sums(const MatrixXd& jacobian, const VectorXd& weighted,
                    const Eigen::Ref<const Positions>& positions, double block) {
  std::map<std::pair<double, double>, VectorXd> sums;
  for (Eigen::Index i = 0; i < jacobian.rows(); ++i) {
    const auto position = positions.row(i % positions.rows());
    const std::pair cell(std::floor(position[0] / block), std::floor(position[1] / block));
    auto [sum, first] = sums.try_emplace(cell, VectorXd::Zero(jacobian.cols()));
    sum->second += weighted[i] * jacobian.row(i).transpose();
  }
  MatrixXd rows(sums.size(), jacobian.cols());
  Eigen::Index row = 0;
  for (const auto& [cell, sum] : sums) rows.row(row++) = sum.transpose();
  return rows;
}

}  // namespace

MatrixXd block_covariance(const MatrixXd& jacobian, const VectorXd& weighted, const MatrixXd& normal,
                          const Eigen::Ref<const Positions>& positions, double block) {
  const MatrixXd sums = block_sums(jacobian, weighted, positions, block);
  const Eigen::Index blocks = sums.rows(), parameters = jacobian.cols();
  const MatrixXd unknown =
      MatrixXd::Constant(parameters, parameters, std::numeric_limits<double>::quiet_NaN());
  const VectorXd scale = normal.diagonal().cwiseMax(0.0).cwiseSqrt();
  if (blocks <= parameters || !(scale.minCoeff() > 0.0) || !scale.allFinite()) return unknown;
  const MatrixXd scaled = (scale.cwiseInverse().asDiagonal() * normal) * scale.cwiseInverse().asDiagonal();
  if (!(condition(scaled) <= kMaxCondition)) return unknown;
  const MatrixXd inverse =
      scale.cwiseInverse().asDiagonal() * scaled.inverse() * scale.cwiseInverse().asDiagonal();
  const double few = static_cast<double>(blocks) / static_cast<double>(blocks - parameters);
  return few * inverse * (sums.transpose() * sums) * inverse;
}

}  // namespace terrainloop::matching
