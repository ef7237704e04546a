#pragma once

#include <Eigen/Dense>

namespace terrainloop::matching {

using Eigen::MatrixXd;
using Eigen::VectorXd;

/// Rows of positions (x, y), metres.
using Positions = Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>;

/// Sandwich covariance of a weighted least-squares fit whose residuals are correlated over the ground, with
/// square blocks of it as the independent units.
///
/// Residuals are those at N positions, or N of each of several components one after the other; `weighted` has
/// them times their weights at the optimum, `normal` is J' W J and `block` the side of a block, metres. NaN
/// where there are not more blocks than parameters, or a parameter is undetermined.
MatrixXd block_covariance(const MatrixXd& jacobian, const VectorXd& weighted, const MatrixXd& normal,
                          const Eigen::Ref<const Positions>& positions, double block);

}  // namespace terrainloop::matching
