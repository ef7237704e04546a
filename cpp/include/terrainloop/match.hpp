#pragma once

#include <array>
#include <string>

#include "terrainloop/gradient_map.hpp"

/// Whether two gradient maps show the same place, and the transform between them: what `register` decides in
/// Python without keypoints. docs/matching.md explains the method.
namespace terrainloop {

/// Measured constants that `max_false_loops` rests on, equal to Python's (docs/matching.md); not meant to be
/// changed.
struct Calibration {
  // The gradient field
  double pixels_per_length_scale = 2.0;
  int max_pixels = 96;              ///< across; larger maps take twice the spacing
  double blur = 0.4;                ///< standard deviation of the low-pass filter, pixels
  double spectrum_smoothing = 1.5;  ///< of the power spectrum, cycles per width
  double whitening_floor = 0.3;     ///< added to the spectrum, share of its mean
  double clip = 1.5;                ///< soft-clipping scale, robust standard deviations
  // Hypotheses
  double rotation_step = 1.0;     ///< pixels ground moves by, RMS, per rotation
  double min_shared_area = 20.0;  ///< squared length scales
  double min_separation = 1.5;    ///< between two places, length scales
  double peak_threshold = 6.0;    ///< r^2 of a candidate, in units of its mean
  double wraparound = 0.8;        ///< FFT size, share of that without wrap-around
  int candidates = 11;            ///< places whose surprisal is kept for the null
  int dense_hypotheses = 2;       ///< places refined to see if a pair is significant; if it is, all are
  // Significance
  double tail = 0.85;               ///< calibrated nats per nat of the correlation's formula
  double independent_tests = 0.05;  ///< per rotation step and squared length scale of shift
  double max_correlation = 0.999;   ///< beyond which none counts more
  // Decision
  double min_correlation = 0.25;   ///< of the fields of a loop closure
  double min_participation = 0.2;  ///< of the shared ground, that the agreement rests on
  double ambiguity_ratio = 0.5;    ///< surprisal of a rival pose, share of the best's
  double equivalence_ratio = 0.7;  ///< the same, above which a rival counts however likely it is by chance
  double ambiguity_chance = 0.01;  ///< NFA above which a rival is left to chance
  // Covariance
  double block = 2.0;               ///< side of the independent blocks of ground, length scales
  double noise_factor = 2.5;        ///< variance of a pose by noise, over that of independent blocks
  double warp_noise_factor = 5.0;   ///< the same of a warp
  double usual_warp = 0.0009;       ///< standard deviation of a submap's warp, a priori
  double usual_warp_samples = 1.0;  ///< samples that this prior is worth
  double reach_of_radius = 2.8;     ///< squared reach per squared radius of the shared ground
  std::array<double, 3> motion_by_warp = {60.0, 60.0, 26.0};     ///< variance of x, y, z per m^2 of reach
  std::array<double, 3> rotation_by_warp = {40.0, 40.0, 350.0};  ///< variance of roll, pitch, yaw
};

struct MatchSettings {
  double pairs = 1.0;             ///< compared in the mission
  double max_false_loops = 0.01;  ///< expected number of false loop closures in all of them
  Calibration calibration;
};

/// The decision on one pair of maps. Without a hypothesis the transform, the correlation, the area and
/// log_nfa are NaN and the score is -10.
struct Match {
  bool accepted;
  std::string reason;  ///< in words, why it was accepted or not
  /// SE(3), row-major (4, 4): takes points of the source into the frame of the target, metres.
  std::array<double, 16> T_target_source;
  /// Row-major (6, 6), of (x, y, z, roll, pitch, yaw) with R = Rz Ry Rx, metres and radians, of the transform
  /// between the frames moved to the two origins below: it takes (point of the source - source_origin) to
  /// (point of the target - target_origin). NaN where it is not known, as for every
  /// pair that is rejected.
  std::array<double, 36> covariance;
  /// Zero, or a point near the map where its frame's origin is far away (UTM), metres.
  std::array<double, 3> source_origin, target_origin;
  double correlation;  ///< of the two gradient fields over the shared ground
  double area;         ///< shared, m^2
  double score;        ///< -log_nfa, or -10 where no hypothesis agrees well enough
  double log_nfa;      ///< decimal logarithm of the number of matches as good that chance yields in one pair
  double overlap;      ///< intersection over union of the observed areas, 0 to 1
};

/// Decides whether two maps show the same place. Deterministic, within tens of milliseconds for
/// ordinary maps; starts no threads.
/// Throws std::invalid_argument for maps and settings that are impossible.
Match match(const GradientMapView& source, const GradientMapView& target, const MatchSettings& settings = {});

}  // namespace terrainloop
