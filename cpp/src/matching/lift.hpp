#pragma once

#include <Eigen/Dense>
#include <array>

#include "overlay.hpp"

/// From an SE(2) alignment to SE(3): height and tilt from the elevations, and the covariance. Everything is
/// estimated about a pivot, the middle of the overlap, where a tilt causes no horizontal motion, and then
/// referred to the maps' local origins.
namespace terrainloop::matching {

using Eigen::Matrix4d;
using Eigen::Vector3d;
using Matrix6d = Eigen::Matrix<double, 6, 6>;

/// How well an SE(2) alignment of rigid submaps is known.
struct PlanarPrecision {
  Vector2d pivot;       ///< in the target frame, metres
  Matrix3d covariance;  ///< of (x, y, yaw) at the pivot
};

struct Lifted {
  Matrix4d T_target_source;
  Matrix6d covariance;  ///< of (x, y, z, roll, pitch, yaw) between the local origins
};

/// A map and the point that its loops' covariances refer to.
struct Anchored {
  const GradientMapView& map;
  Vector3d local_origin;
};

/// Zero, or the middle of the map in whole metres where the frame's origin is more than ten radii away.
Vector3d local_origin(const GradientMapView& map);

/// The covariance is NaN where the overlap is too small to determine the tilt.
Lifted lift_to_se3(const Anchored& source, const Anchored& target, const Overlay& overlay,
                   const Matrix3d& T_planar, const PlanarPrecision& precision,
                   const Calibration& calibration);

}  // namespace terrainloop::matching
