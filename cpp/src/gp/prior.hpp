#pragma once

#include <Eigen/Dense>
#include <vector>

/// The prior of the spline's weights along one axis; in the plane it is the product of two.
namespace terrainloop::gp {

using Matrix = Eigen::MatrixXd;

constexpr double kKnotSpacing = 0.5;  ///< in length scales

/// Covariance c_0 ... c_{count - 1} of weights that are n knots apart, for unit variance of the elevation:
/// its spectrum is k^(w) / b(w)^2, with which the spline has the kernel's covariance at the knots.
std::vector<double> weight_covariance(int count);

/// The symmetric Toeplitz matrix (size, size) of a first row at least that long.
Matrix toeplitz(const std::vector<double>& row, int size);

/// Inverse of a symmetric positive-definite matrix; throws std::runtime_error if it is not one.
Matrix inverse(const Matrix& matrix);

}  // namespace terrainloop::gp
