#include "prior.hpp"

#include <cmath>
#include <stdexcept>

namespace terrainloop::gp {
namespace {

constexpr double kPi = 3.14159265358979323846;

/// Fourier transform over the knots of the kernel's samples.
double kernel_spectrum(double w) {
  double sum = 0.0;
  for (int alias = -4; alias <= 4; ++alias) {
    const double u = (w + 2.0 * kPi * alias) / kKnotSpacing;
    sum += std::exp(-0.5 * u * u);
  }
  return std::sqrt(2.0 * kPi) / kKnotSpacing * sum;
}

/// Fourier transform of the samples of the B-spline of degree 7 at the knots.
double spline_spectrum(double w) {
  return (2416.0 + 2382.0 * std::cos(w) + 240.0 * std::cos(2.0 * w) + 2.0 * std::cos(3.0 * w)) / 5040.0;
}

}  // namespace

std::vector<double> weight_covariance(int count) {
  const int samples = 2 * count + 256;  // the trapezoid rule: the error falls as 0.54^256
  std::vector<double> covariance(count, 0.0), cosine(samples);
  for (int m = 0; m < samples; ++m) cosine[m] = std::cos(2.0 * kPi * m / samples);
  for (int m = 0; m < samples; ++m) {
    const double w = 2.0 * kPi * m / samples;
    const double folded = m > samples / 2 ? w - 2.0 * kPi : w;
    const double spectrum = kernel_spectrum(folded) / std::pow(spline_spectrum(w), 2) / samples;
    for (int n = 0; n < count; ++n) covariance[n] += spectrum * cosine[static_cast<long>(m) * n % samples];
  }
  return covariance;
}

Matrix toeplitz(const std::vector<double>& row, int size) {
  return Matrix::NullaryExpr(size, size,
                             [&](Eigen::Index i, Eigen::Index j) { return row[std::abs(i - j)]; });
}

Matrix inverse(const Matrix& matrix) {
  const Eigen::LLT<Matrix> factor(matrix);
  if (factor.info() != Eigen::Success) throw std::runtime_error("the prior is not positive definite");
  Matrix result = factor.solve(Matrix::Identity(matrix.rows(), matrix.cols()));
  return 0.5 * (result + result.transpose());
}

}  // namespace terrainloop::gp
