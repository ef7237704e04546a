#include "refinement.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace terrainloop::matching {
namespace {

constexpr double kSamplesPerLengthScale = 3.0;  // denser samples are redundant

using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

Eigen::Map<const VectorXd> vector(const std::vector<double>& values) {
  return {values.data(), static_cast<Eigen::Index>(values.size())};
}

Eigen::Map<const Rows> rows(const std::vector<double>& values, Eigen::Index cols) {
  return {values.data(), static_cast<Eigen::Index>(values.size()) / cols, cols};
}

refine::Gradients gradients_of(const GradientMapView& map) {
  return {map.gradient_x, map.gradient_y, map.gradient_variance, map.mask,
          map.origin_x,   map.origin_y,   map.resolution};
}

MatrixXd normal_matrix(const MatrixXd& jacobian, const std::vector<double>& weights) {
  return jacobian.transpose() * vector(weights).asDiagonal() * jacobian;
}

}  // namespace

std::optional<Refinement> Refinement::of(const GradientMapView& source, const GradientMapView& target,
                                         const Matrix3d& T, const Calibration& calibration,
                                         const Effort& effort) {
  const double length_scale = target.length_scale;
  const double step = std::nearbyint(length_scale / kSamplesPerLengthScale / target.resolution);
  const refine::Settings settings{static_cast<int>(std::max(1.0, step)), effort.samples, effort.steps,
                                  effort.tolerance * length_scale};
  std::optional<refine::Linearised> refined = refine::settle(gradients_of(source), gradients_of(target),
                                                             {T(0, 0), T(1, 0), T(0, 2), T(1, 2)}, settings);
  if (!refined) return std::nullopt;
  return Refinement(*std::move(refined), calibration.block * length_scale, calibration);
}

Matrix3d Refinement::T_target_source() const {
  const auto& [c, s, x, y] = at_.motion;
  return (Matrix3d() << c, -s, x, s, c, y, 0, 0, 1).finished();
}

MatrixXd Refinement::by_motion() const { return rows(at_.by_motion, 5); }

Matrix3d Refinement::covariance() const {
  const MatrixXd jacobian = by_motion();
  const VectorXd weighted = vector(at_.weights).cwiseProduct(vector(at_.residual));
  const VectorXd motion = -normal_matrix(jacobian, at_.weights)
                               .completeOrthogonalDecomposition()
                               .solve(jacobian.transpose() * weighted);
  const VectorXd remaining = vector(at_.weights).cwiseProduct(vector(at_.residual) + jacobian * motion);
  const Eigen::Map<const Positions> ground(at_.ground.data(),
                                           static_cast<Eigen::Index>(at_.ground.size() / 2), 2);
  const MatrixXd covariance =
      block_covariance(jacobian, remaining, normal_matrix(jacobian, at_.slopes), ground, block_);
  return calibration_.noise_factor * covariance.topLeftCorner<3, 3>();
}

std::array<Matrix3d, 2> Refinement::weakest(double distance) const {
  const Eigen::Map<const Positions> ground(at_.ground.data(),
                                           static_cast<Eigen::Index>(at_.ground.size() / 2), 2);
  const double radius = std::sqrt((ground.rowwise() - pivot().transpose()).rowwise().squaredNorm().mean());
  MatrixXd jacobian = by_motion();
  jacobian.col(2) /= radius;
  const MatrixXd normal = normal_matrix(jacobian, at_.weights);
  const MatrixXd slopes =
      normal.bottomRightCorner<2, 2>().partialPivLu().solve(normal.bottomLeftCorner<2, 3>());
  const Matrix3d reduced = normal.topLeftCorner<3, 3>() - normal.topRightCorner<3, 2>() * slopes;
  const Eigen::Vector3d away =
      distance * Eigen::SelfAdjointEigenSolver<Matrix3d>(reduced).eigenvectors().col(0);
  return {moved(away[0], away[1], away[2] / radius), moved(-away[0], -away[1], -away[2] / radius)};
}

/// The pose after a rotation about the pivot and a shift, in the target frame.
Matrix3d Refinement::moved(double dx, double dy, double yaw) const {
  return se2(dx, dy, 0.0) * rotation_about(pivot(), yaw) * T_target_source();
}

}  // namespace terrainloop::matching
