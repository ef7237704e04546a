#include "pose_search.hpp"

#include <algorithm>
#include <cmath>

#include "fft.hpp"
#include "query.hpp"
#include "search.hpp"
#include "significance.hpp"

namespace terrainloop::matching {
namespace {

constexpr double kTurn = 2.0 * search::kPi;

struct Peak {
  double surprisal;
  int rotation, row, col;
};

std::vector<Peak> peaks_of(const std::vector<search::Pose>& found, int size, const Field& target,
                           const Calibration& calibration) {
  std::vector<Peak> peaks;
  for (const search::Pose& pose : found)
    peaks.push_back({surprisal_of_correlation(pose.squared_correlation, pose.samples, calibration),
                     pose.rotation, pose.row - (pose.row >= target.rows ? size : 0),
                     pose.column - (pose.column >= target.cols ? size : 0)});  // negative shifts
  return peaks;
}

/// The most surprising peaks, each `separation` pixels from those before. Sources are rotated about their
/// centroid, so that a shift is its displacement; from one rotation to the next ground moves by `arc` pixels.
std::vector<Peak> distinct_peaks(std::vector<Peak> peaks, double separation, int rotations, double arc,
                                 int count) {
  std::vector<Peak> chosen;
  while (static_cast<int>(chosen.size()) < count && !peaks.empty()) {
    const auto less = [](const Peak& a, const Peak& b) { return a.surprisal < b.surprisal; };
    const Peak best = *std::max_element(peaks.begin(), peaks.end(), less);
    if (!(best.surprisal > 0.0)) break;
    chosen.push_back(best);
    const auto beside = [&](const Peak& peak) {
      const int turned = std::abs(peak.rotation - best.rotation);
      const double shifted = std::hypot(peak.row - best.row, peak.col - best.col);
      return std::max(shifted, std::min(turned, rotations - turned) * arc) < separation;
    };
    peaks.erase(std::remove_if(peaks.begin(), peaks.end(), beside), peaks.end());
  }
  return chosen;
}

}  // namespace

double SearchResult::null_area_at(double yaw) const {
  const int count = static_cast<int>(null_area.size());
  const int nearest = static_cast<int>(std::nearbyint(yaw / kTurn * count));
  return null_area[(nearest % count + count) % count];
}

SearchResult search_poses(const Field& source, const Field& target, const Calibration& calibration) {
  const double spacing = target.spacing;
  const double pixels = std::pow(std::max(source.length_scale, target.length_scale) / spacing, 2);
  const int size = search_size(source, target, calibration);
  const Query query = query_of(source, size, calibration);
  const StoredField stored = stored_field_of(target, size);
  const int rotations = static_cast<int>(query.poses.size());
  search::Correlations found =
      search::correlate({query.fields.data(), query.area.data(), rotations / search::kLanes},
                        {stored.field.data(), stored.area.data()}, size, calibration.min_shared_area * pixels,
                        calibration.peak_threshold);
  const double arc = kTurn * source.radius / spacing / std::max(rotations, 1);
  const std::vector<Peak> best =
      distinct_peaks(peaks_of(found.evident, size, target, calibration),
                     calibration.min_separation * std::sqrt(pixels), rotations, arc, calibration.candidates);
  SearchResult result{{}, {}, std::move(found.sample), 0.0};
  for (double& area : result.null_area) area *= spacing * spacing;
  for (const double admissible : found.admissible)
    result.tried += admissible * arc / calibration.rotation_step / pixels;
  for (const Peak& peak : best) {
    const Matrix3d shift = se2(peak.col, peak.row, 0.0);
    result.poses.push_back(target.metres_from_pixels() * shift * query.poses[peak.rotation]);
    result.surprisals.push_back(peak.surprisal);
  }
  return result;
}

bool same_place(const Matrix3d& T, const Matrix3d& other, const Field& source,
                const Calibration& calibration) {
  const double shift = (transform(T, source.centre) - transform(other, source.centre)).norm();
  const double rotation = std::abs(yaw_of(inverse(T) * other)) * source.radius;
  return std::max(shift, rotation) < calibration.min_separation * source.length_scale;
}

}  // namespace terrainloop::matching
