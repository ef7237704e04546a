#pragma once

#include <vector>

#include "gradient_field.hpp"

namespace terrainloop::matching {

/// What an exhaustive search of SE(2) found.
struct SearchResult {
  std::vector<Matrix3d> poses;     ///< T_target_source of distinct places, best first
  std::vector<double> surprisals;  ///< of these poses
  /// For each of evenly spaced rotations, the area that counts as one independent sample, m^2; NaN where no
  /// shift shares enough ground.
  std::vector<double> null_area;
  double tried;  ///< poses: rotations, in units of rotation_step, times shifts, in squared length scales

  double null_area_at(double yaw) const;  ///< of the rotation nearest to a yaw in radians
};

/// Compares two fields of one spacing at every rotation and at every shift that shares enough ground, by FFT.
SearchResult search_poses(const Field& source, const Field& target, const Calibration& calibration);

/// Whether two poses of a source are closer to each other than the places that a search distinguishes.
bool same_place(const Matrix3d& T, const Matrix3d& other, const Field& source,
                const Calibration& calibration);

}  // namespace terrainloop::matching
