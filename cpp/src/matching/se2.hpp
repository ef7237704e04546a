#pragma once

#include <Eigen/Dense>
#include <cmath>

#include "terrainloop/field.hpp"

/// Rigid motions of the plane, and affine maps of its pixels, as homogeneous matrices.
namespace terrainloop::matching {

using Eigen::Matrix3d;
using Eigen::Vector2d;

inline Matrix3d se2(double x, double y, double yaw) {
  const double c = std::cos(yaw), s = std::sin(yaw);
  return (Matrix3d() << c, -s, x, s, c, y, 0, 0, 1).finished();
}

inline double yaw_of(const Matrix3d& T) { return std::atan2(T(1, 0), T(0, 0)); }

inline Vector2d transform(const Matrix3d& T, const Vector2d& point) {
  return T.topLeftCorner<2, 2>() * point + T.topRightCorner<2, 1>();
}

/// Of a rigid motion.
inline Matrix3d inverse(const Matrix3d& T) {
  Matrix3d result = Matrix3d::Identity();
  result.topLeftCorner<2, 2>() = T.topLeftCorner<2, 2>().transpose();
  result.topRightCorner<2, 1>() = -(T.topLeftCorner<2, 2>().transpose() * T.topRightCorner<2, 1>());
  return result;
}

/// A rotation about a point.
inline Matrix3d rotation_about(const Vector2d& centre, double yaw) {
  Matrix3d T = se2(0.0, 0.0, yaw);
  T.topRightCorner<2, 1>() = centre - T.topLeftCorner<2, 2>() * centre;
  return T;
}

/// From (column, row) to metres on the grid of a map or field.
inline Matrix3d metres_from_pixels(double x, double y, double spacing) {
  return (Matrix3d() << spacing, 0, x, 0, spacing, y, 0, 0, 1).finished();
}

inline Lookup lookup_of(const Matrix3d& affine) {
  return {affine(0, 0), affine(0, 1), affine(0, 2), affine(1, 0), affine(1, 1), affine(1, 2)};
}

}  // namespace terrainloop::matching
