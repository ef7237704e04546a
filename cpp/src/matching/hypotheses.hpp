#pragma once

#include <vector>

#include "overlay.hpp"
#include "pose_search.hpp"

namespace terrainloop::matching {

/// A relative pose and the evidence for it.
struct Hypothesis {
  Matrix3d T_target_source;
  Agreement agreement;
  double surprisal;  ///< -ln P(agreement at least this good | unrelated ground) in one test, nats
};

/// Two maps under comparison, and all that hypotheses about them are weighed with.
struct Pair {
  Pair(const GradientMapView& source, const GradientMapView& target, const Calibration& calibration);

  double length_scale() const;  ///< the longer one of the two maps, metres
  bool same_place(const Matrix3d& T, const Matrix3d& other) const;

  /// The evidence for a pose; none where the overlap is too small or the fields disagree.
  Hypothesis weigh(const Matrix3d& T) const;

  /// Places of the search from the first to before the last, each at the pose near it where the gradients
  /// agree best.
  std::vector<Hypothesis> propose(std::size_t first, std::size_t last) const;

  const GradientMapView &source, &target;
  const Calibration& calibration;
  Field source_field, target_field;  ///< at the coarser spacing of the two
  SearchResult found;

 private:
  Hypothesis refined(const Hypothesis& hypothesis) const;
};

}  // namespace terrainloop::matching
