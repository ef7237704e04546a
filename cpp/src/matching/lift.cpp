#include "lift.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <optional>
#include <vector>

#include "../median.hpp"
#include "block_covariance.hpp"

namespace terrainloop::matching {
namespace {

constexpr Eigen::Index kMinPixels = 10;  // that determine a tilt
constexpr double kOutlier = 3.0;         // robust standard deviations of an elevation difference
constexpr double kNormal = 1.4826;       // standard deviations in a median absolute deviation
constexpr double kFar = 10.0;            // radii of the map, from which its frame's origin is no longer near
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// Elevation difference as z + w_x y - w_y x.
struct Plane {
  Vector3d parameters;  ///< (z, w_x, w_y)
  Matrix3d covariance;
};

/// The rows that are kept of a fit.
struct Samples {
  Positions positions;  ///< from the pivot
  VectorXd difference;

  MatrixXd design() const {
    MatrixXd columns(positions.rows(), 3);
    columns << VectorXd::Ones(positions.rows()), positions.col(1), -positions.col(0);
    return columns;
  }

  Vector3d fit() const {
    const MatrixXd columns = design();
    const Matrix3d normal = columns.transpose() * columns;
    return normal.completeOrthogonalDecomposition().solve(columns.transpose() * difference);
  }

  VectorXd residual(const Vector3d& plane) const { return difference - design() * plane; }

  Samples of(const std::vector<Eigen::Index>& rows) const {
    return {positions(rows, Eigen::all), difference(rows)};
  }
};

/// Rows whose residual is no outlier.
std::vector<Eigen::Index> inliers(const VectorXd& residual) {
  std::vector<double> distances(residual.data(), residual.data() + residual.size());
  const double middle = median(distances);
  for (double& distance : distances) distance = std::abs(distance - middle);
  const double limit = std::max(kOutlier * kNormal * median(std::move(distances)), 1e-9);
  std::vector<Eigen::Index> rows;
  for (Eigen::Index i = 0; i < residual.size(); ++i)
    if (std::abs(residual[i]) <= limit) rows.push_back(i);
  return rows;
}

/// By least squares with outliers rejected once; nothing if undetermined.
std::optional<Plane> fit_plane(const Samples& samples, double block) {
  if (samples.difference.size() < kMinPixels) return std::nullopt;
  const Samples kept = samples.of(inliers(samples.residual(samples.fit())));
  if (kept.difference.size() < kMinPixels) return std::nullopt;
  const Vector3d plane = kept.fit();
  const MatrixXd design = kept.design();
  const MatrixXd covariance =
      block_covariance(design, kept.residual(plane), design.transpose() * design, kept.positions, block);
  if (covariance.hasNaN()) return std::nullopt;
  return Plane{plane, covariance};
}

Samples samples_of(const Overlay& overlay, const Vector2d& pivot) {
  const auto count = static_cast<Eigen::Index>(overlay.source_elevation.size());
  const Eigen::Map<const Positions> positions(overlay.positions.data(), count, 2);
  const Eigen::Map<const VectorXd> source(overlay.source_elevation.data(), count),
      target(overlay.target_elevation.data(), count);
  return {positions.rowwise() - pivot.transpose(), target - source};
}

/// Distance from a position to the local origin, or to the point of the map nearest to it: over this distance
/// a submap that is not rigid has accumulated its errors.
double reach(const Anchored& at, const Vector2d& position) {
  const GradientMapView& map = at.map;
  const Vector2d low(map.origin_x, map.origin_y);
  const Vector2d high = low + map.resolution * Vector2d(map.mask.cols - 1, map.mask.rows - 1);
  return (position - at.local_origin.head<2>().cwiseMax(low).cwiseMin(high)).norm();
}

Matrix3d cross_matrix(const Vector3d& v) {
  return (Matrix3d() << 0, -v.z(), v.y(), v.z(), 0, -v.x(), -v.y(), v.x(), 0).finished();
}

/// From (x, y, z, w_x, w_y, yaw) at the pivot to (x, y, z, roll, pitch, yaw) of the transform.
///
/// The translation is the pivot minus the arm, which leads there from the source's local origin; a rotation w
/// changes the arm by w x arm. Roll and pitch are about the source's axes, w_x and w_y about the target's.
Matrix6d at_local_origin(const Matrix6d& covariance, const Vector3d& arm, double yaw) {
  Matrix6d jacobian = Matrix6d::Identity();
  jacobian.topRightCorner<3, 3>() = cross_matrix(arm);
  jacobian.block<2, 2>(3, 3) = se2(0.0, 0.0, yaw).topLeftCorner<2, 2>().transpose();
  const Matrix6d moved = jacobian * covariance * jacobian.transpose();
  return (moved + moved.transpose()) / 2.0;  // rounding breaks the symmetry
}

/// Of (x, y, z, w_x, w_y, yaw) at the pivot.
Matrix6d covariance_at_pivot(const PlanarPrecision& precision, const Matrix3d& of_plane, double squared_reach,
                             const Calibration& calibration) {
  const std::array<int, 3> planar = {0, 1, 5}, tilt = {2, 3, 4};
  Matrix6d covariance = Matrix6d::Zero();
  covariance(planar, planar) = precision.covariance;
  covariance(tilt, tilt) = of_plane;
  for (int i = 0; i < 3; ++i) {
    covariance(i, i) += precision.strain_variance * squared_reach * calibration.motion_by_strain[i];
    covariance(3 + i, 3 + i) += precision.strain_variance * calibration.rotation_by_strain[i];
  }
  return covariance;
}

Matrix4d in_space(const Matrix3d& R, const Vector3d& translation) {
  Matrix4d T = Matrix4d::Identity();
  T.topLeftCorner<3, 3>() = R;
  T.topRightCorner<3, 1>() = translation;
  return T;
}

}  // namespace

Vector3d local_origin(const GradientMapView& map) {
  const Vector2d half = map.resolution / 2.0 * Vector2d(map.mask.cols - 1, map.mask.rows - 1);
  const Vector2d middle = Vector2d(map.origin_x, map.origin_y) + half;
  if (!(middle.norm() > kFar * half.norm())) return Vector3d::Zero();
  std::vector<double> elevations;
  const std::size_t pixels = static_cast<std::size_t>(map.mask.rows) * map.mask.cols;
  for (std::size_t i = 0; i < pixels; ++i)
    if (map.mask.data[i]) elevations.push_back(map.elevation.data[i]);
  const double height = elevations.empty() ? 0.0 : median(std::move(elevations));
  return {std::nearbyint(middle.x()), std::nearbyint(middle.y()), std::nearbyint(height)};
}

Lifted lift_to_se3(const Anchored& source, const Anchored& target, const Overlay& overlay,
                   const Matrix3d& T_planar, const PlanarPrecision& precision,
                   const Calibration& calibration) {
  const Vector2d& pivot = precision.pivot;
  Matrix3d turn = Matrix3d::Identity();
  turn.topLeftCorner<2, 2>() = T_planar.topLeftCorner<2, 2>();
  const std::optional<Plane> plane =
      fit_plane(samples_of(overlay, pivot), calibration.block * target.map.length_scale);
  if (!plane) return {in_space(turn, {T_planar(0, 2), T_planar(1, 2), 0.0}), Matrix6d::Constant(kNan)};
  const auto [z, w_x, w_y] = std::array{plane->parameters[0], plane->parameters[1], plane->parameters[2]};
  const Matrix3d R = Eigen::AngleAxisd(w_y, Vector3d::UnitY()).toRotationMatrix() *
                     Eigen::AngleAxisd(w_x, Vector3d::UnitX()).toRotationMatrix() * turn;
  const std::vector<double>& heights = overlay.source_elevation;
  const double height =
      std::accumulate(heights.begin(), heights.end(), 0.0) / static_cast<double>(heights.size());
  const Vector2d pivot_planar = transform(inverse(T_planar), pivot);
  const Vector3d pivot_source(pivot_planar.x(), pivot_planar.y(), height);
  const Vector3d pivot_target(pivot.x(), pivot.y(), height + z);
  const double squared_reach = std::pow(reach(target, pivot), 2) + std::pow(reach(source, pivot_planar), 2);
  const Matrix6d covariance = covariance_at_pivot(precision, plane->covariance, squared_reach, calibration);
  const double yaw = std::atan2(R(1, 0), R(0, 0));
  return {in_space(R, pivot_target - R * pivot_source),
          at_local_origin(covariance, R * (pivot_source - source.local_origin), yaw)};
}

}  // namespace terrainloop::matching
