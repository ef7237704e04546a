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
constexpr int kSteps = 10;               // in which the weights of the samples of a warp settle
constexpr double kFar = 10.0;            // radii of the map, from which its frame's origin is no longer near
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// What is left of a least-squares fit of the elevation difference.
struct Fit {
  VectorXd parameters;
  MatrixXd covariance;  ///< NaN if undetermined
};

/// The elevation difference over the ground that two maps share.
struct Ground {
  Positions positions;  ///< from the pivot
  VectorXd difference;
  Positions slope;

  /// Its derivative by (z, w_x, w_y).
  MatrixXd design() const {
    MatrixXd columns(positions.rows(), 3);
    columns << VectorXd::Ones(positions.rows()), positions.col(1), -positions.col(0);
    return columns;
  }

  /// Its derivative by (x, y, yaw) of the alignment.
  MatrixXd by_alignment() const {
    MatrixXd columns(positions.rows(), 3);
    columns << slope,
        positions.col(0).cwiseProduct(slope.col(1)) - positions.col(1).cwiseProduct(slope.col(0));
    return columns;
  }

  /// Root mean square distance from the pivot.
  double radius() const { return std::sqrt(positions.squaredNorm() / static_cast<double>(positions.rows())); }

  /// The design and, as rises over the radius, the second-degree parts.
  MatrixXd bent_design() const {
    const double unit = radius();
    const Eigen::ArrayXd x = positions.col(0).array() / unit, y = positions.col(1).array() / unit;
    MatrixXd columns(positions.rows(), 6);
    columns << design(), unit * (x.square() - y.square()), 2.0 * unit * x * y,
        unit * (x.square() + y.square() - 1.0);
    return columns;
  }

  Ground of(const std::vector<Eigen::Index>& rows) const {
    return {positions(rows, Eigen::all), difference(rows), slope(rows, Eigen::all)};
  }

  Fit fit(const MatrixXd& columns, double block) const {
    const MatrixXd normal = columns.transpose() * columns;
    const VectorXd parameters =
        normal.completeOrthogonalDecomposition().solve(columns.transpose() * difference);
    const VectorXd residual = difference - columns * parameters;
    return {parameters, block_covariance(columns, residual, normal, positions, block)};
  }
};

/// Elevation difference as z + w_x y - w_y x, and the rest of it.
struct Plane {
  Vector3d parameters;    ///< (z, w_x, w_y)
  Matrix3d covariance;    ///< by the scatter of the elevations
  Matrix3d by_alignment;  ///< derivative of the parameters by (x, y, yaw) of the alignment
  double warp_variance;   ///< of one submap
  double radius;          ///< of the ground, metres

  /// Of (x, y, z, w_x, w_y, yaw) at the pivot, from that of (x, y, yaw).
  Matrix6d covariance_with(const Matrix3d& alignment) const {
    const std::array<int, 3> planar = {0, 1, 5}, tilt = {2, 3, 4};
    const Matrix3d both = by_alignment * alignment;
    Matrix6d result;
    result(planar, planar) = alignment;
    result(tilt, planar) = both;
    result(planar, tilt) = both.transpose();
    result(tilt, tilt) = covariance + both * by_alignment.transpose();
    return result;
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

/// Of one submap, from the second-degree parts of this pair less their noise, and what is usual.
double warp_variance(const Eigen::Array3d& squares, const Eigen::Array3d& noise, const Calibration& c) {
  const double usual = c.usual_warp * c.usual_warp, prior = c.usual_warp_samples;
  if (noise.isNaN().any()) return usual;
  double variance = usual;
  for (int step = 0; step < kSteps; ++step) {
    const Eigen::Array3d weights = (1.0 + noise / std::max(variance, usual)).square().inverse();
    const double excess = std::max((weights * (squares - noise)).sum(), 0.0);
    variance = (prior * usual + excess) / (prior + weights.sum());
  }
  return variance;
}

/// By least squares, after outliers from a bent plane were rejected; nothing if undetermined.
std::optional<Plane> fit_plane(const Ground& ground, const Calibration& calibration, double length_scale) {
  if (ground.difference.size() < kMinPixels) return std::nullopt;
  const double block = calibration.block * length_scale;
  const MatrixXd all = ground.bent_design();
  const VectorXd first =
      (all.transpose() * all).completeOrthogonalDecomposition().solve(all.transpose() * ground.difference);
  const Ground kept = ground.of(inliers(ground.difference - all * first));
  if (kept.difference.size() < kMinPixels) return std::nullopt;
  const MatrixXd columns = kept.design();
  const Fit plane = kept.fit(columns, block), bent = kept.fit(kept.bent_design(), block);
  if (plane.covariance.hasNaN()) return std::nullopt;
  const double radius = kept.radius();
  const Eigen::Array3d warp = bent.parameters.tail<3>();
  const Eigen::Array3d noise = calibration.warp_noise_factor * bent.covariance.diagonal().tail<3>();
  const Matrix3d by_alignment = (columns.transpose() * columns)
                                    .completeOrthogonalDecomposition()
                                    .solve(columns.transpose() * kept.by_alignment());
  return Plane{plane.parameters, calibration.noise_factor * plane.covariance, by_alignment,
               warp_variance(warp.square() / 2.0, noise / 2.0, calibration), radius};
}

Ground ground_of(const Overlay& overlay, const Vector2d& pivot) {
  const auto count = static_cast<Eigen::Index>(overlay.source_elevation.size());
  const Eigen::Map<const Positions> positions(overlay.positions.data(), count, 2),
      slope(overlay.slope.data(), count, 2);
  const Eigen::Map<const VectorXd> source(overlay.source_elevation.data(), count),
      target(overlay.target_elevation.data(), count);
  return {positions.rowwise() - pivot.transpose(), target - source, slope};
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

/// What a warp adds to the covariance of (x, y, z, w_x, w_y, yaw) at the pivot.
Matrix6d by_warp(double variance, double squared_reach, const Calibration& calibration) {
  Matrix6d added = Matrix6d::Zero();
  for (int i = 0; i < 3; ++i) {
    added(i, i) = variance * squared_reach * calibration.motion_by_warp[i];
    added(3 + i, 3 + i) = variance * calibration.rotation_by_warp[i];
  }
  return added;
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
      fit_plane(ground_of(overlay, pivot), calibration, target.map.length_scale);
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
  const double away = std::pow(reach(target, pivot), 2) + std::pow(reach(source, pivot_planar), 2);
  const double squared_reach = away + 2.0 * calibration.reach_of_radius * std::pow(plane->radius, 2);
  const Matrix6d covariance = plane->covariance_with(precision.covariance) +
                              by_warp(plane->warp_variance, squared_reach, calibration);
  const double yaw = std::atan2(R(1, 0), R(0, 0));
  return {in_space(R, pivot_target - R * pivot_source),
          at_local_origin(covariance, R * (pivot_source - source.local_origin), yaw)};
}

}  // namespace terrainloop::matching
