#pragma once

#include <array>
#include <optional>

#include "block_covariance.hpp"
#include "se2.hpp"
#include "terrainloop/match.hpp"
#include "terrainloop/refine.hpp"

namespace terrainloop::matching {

/// How far a refinement goes.
struct Effort {
  int samples, steps;  ///< at most
  double tolerance;    ///< RMS motion of the ground at which it has converged, length scales
};

constexpr Effort kThorough{20'000, 10, 1e-3};
constexpr Effort kRough{2000, 3, 0.02};  ///< enough to rank hypotheses (docs/matching.md, section 2)

/// A pose at which two gradient maps agree best over their overlap, linearised there.
class Refinement {
 public:
  /// From an alignment off by less than about half a length scale (see refine::settle); nothing where the
  /// maps share too little ground.
  static std::optional<Refinement> of(const GradientMapView& source, const GradientMapView& target,
                                      const Matrix3d& T_target_source, const Calibration& calibration,
                                      const Effort& effort);

  Matrix3d T_target_source() const;
  Vector2d pivot() const { return {at_.pivot_x, at_.pivot_y}; }  ///< middle of the samples, metres

  /// Of (x, y, yaw) about the pivot, metres and radians, if the submaps are rigid; NaN if undetermined.
  Matrix3d covariance() const;

  /// The two poses at a distance in metres along the direction that is constrained least.
  std::array<Matrix3d, 2> weakest(double distance) const;

 private:
  Refinement(refine::Linearised at, double block, const Calibration& calibration)
      : at_(std::move(at)), block_(block), calibration_(calibration) {}
  MatrixXd by_motion() const;
  Matrix3d moved(double dx, double dy, double yaw) const;

  refine::Linearised at_;
  double block_;  // metres
  Calibration calibration_;
};

}  // namespace terrainloop::matching
