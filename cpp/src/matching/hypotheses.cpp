#include "hypotheses.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "refinement.hpp"
#include "significance.hpp"

namespace terrainloop::matching {
namespace {

double common_spacing(const GradientMapView& source, const GradientMapView& target,
                      const Calibration& calibration) {
  return std::max(field_spacing(source, calibration), field_spacing(target, calibration));
}

}  // namespace

Pair::Pair(const GradientMapView& source, const GradientMapView& target, const Calibration& calibration)
    : source(source),
      target(target),
      calibration(calibration),
      source_field(field_of(source, common_spacing(source, target, calibration), calibration)),
      target_field(field_of(target, source_field.spacing, calibration)),
      found(search_poses(source_field, target_field, calibration)) {}

double Pair::length_scale() const { return std::max(source.length_scale, target.length_scale); }

bool Pair::same_place(const Matrix3d& T, const Matrix3d& other) const {
  return matching::same_place(T, other, source_field, calibration);
}

Hypothesis Pair::weigh(const Matrix3d& T) const {
  const Agreement agreement = agreement_at(source_field, target_field, T);
  const double null_area = found.null_area_at(yaw_of(T));
  const bool enough = agreement.area >= calibration.min_shared_area * std::pow(length_scale(), 2);
  if (!enough || !(agreement.correlation > 0.0) || std::isnan(null_area)) return {T, agreement, 0.0};
  return {T, agreement, surprisal_of_field(agreement.correlation, agreement.area / null_area, calibration)};
}

Hypothesis Pair::refined(const Hypothesis& hypothesis) const {
  const std::optional<Refinement> refinement =
      Refinement::of(source, target, hypothesis.T_target_source, calibration, kRough);
  if (!refinement) return hypothesis;
  const Hypothesis better = weigh(refinement->T_target_source());
  return better.surprisal > hypothesis.surprisal ? better : hypothesis;
}

std::vector<Hypothesis> Pair::propose(std::size_t first, std::size_t last) const {
  std::vector<Hypothesis> hypotheses;
  for (std::size_t i = first; i < std::min(last, found.poses.size()); ++i)
    hypotheses.push_back(refined(weigh(found.poses[i])));
  return hypotheses;
}

}  // namespace terrainloop::matching
