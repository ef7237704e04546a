#include "terrainloop/match.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <locale>
#include <optional>
#include <sstream>
#include <string>
#include <vector>

#include "hypotheses.hpp"
#include "lift.hpp"
#include "match_checks.hpp"
#include "refinement.hpp"
#include "significance.hpp"

namespace terrainloop {
namespace {

using namespace matching;

constexpr int kRejectedStep = 3;       // every third row and column is enough to show a rejected pair
constexpr double kNoEvidence = -10.0;  // score of a pair for which no hypothesis could be weighed
constexpr int kTurns = 7;  // parts of a full turn: only round ground looks the same after each of them
constexpr double kPi = 3.141592653589793;
constexpr double kLn10 = 2.302585092994046;
constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

/// The best hypothesis of a pair among its rivals, and what a loop closure needs.
struct Weighed {
  Hypothesis best;                 ///< of the rivals, if there are any
  std::vector<Hypothesis> rivals;  ///< those whose correlation is high enough
  double log_tests;                ///< natural logarithm of the number of tests in this pair
  double needed;  ///< surprisal at which the expected number of false loops is what is allowed, nats

  double log_nfa() const { return (log_tests - best.surprisal) / kLn10; }
  /// Surprisal above which another pose explains the pair as well: a large share of the best's, and either
  /// unlikely by chance or nearly all of it.
  double rivalling(const Calibration& calibration) const {
    const double by_chance = log_tests - std::log(calibration.ambiguity_chance);
    return std::max(calibration.ambiguity_ratio * best.surprisal,
                    std::min(by_chance, calibration.equivalence_ratio * best.surprisal));
  }
  bool significant() const { return best.surprisal >= needed; }
};

Weighed weigh(const Pair& pair, const std::vector<Hypothesis>& hypotheses, const MatchSettings& settings) {
  std::vector<Hypothesis> rivals;
  for (const Hypothesis& hypothesis : hypotheses)
    if (hypothesis.agreement.correlation >= settings.calibration.min_correlation)
      rivals.push_back(hypothesis);
  const std::vector<Hypothesis>& eligible = rivals.empty() ? hypotheses : rivals;
  const auto less = [](const Hypothesis& a, const Hypothesis& b) { return a.surprisal < b.surprisal; };
  const Hypothesis best = *std::max_element(eligible.begin(), eligible.end(), less);
  const double log_tests = log_num_tests(pair.found.tried, pair.found.surprisals, settings.calibration);
  return {best, rivals, log_tests, log_tests + std::log(settings.pairs / settings.max_false_loops)};
}

/// A number with so many significant digits, whatever the program's locale.
std::string number(double value, int digits) {
  std::ostringstream text;
  text.imbue(std::locale::classic());
  text.precision(digits);
  text << value;
  return text.str();
}

/// A number with so many decimals.
std::string fixed(double value, int decimals) {
  std::ostringstream text;
  text.imbue(std::locale::classic());
  text << std::fixed;
  text.precision(decimals);
  text << value;
  return text.str();
}

/// Whether a rival is the place of T, or on the flank of its peak: a thorough refinement arrives there.
bool leads_to(const Pair& pair, const Matrix3d& rival, const Matrix3d& T) {
  if (pair.same_place(rival, T)) return true;
  const std::optional<Refinement> refinement =
      Refinement::of(pair.source, pair.target, rival, pair.calibration, kThorough);
  return refinement && pair.same_place(refinement->T_target_source(), T);
}

/// Which poses explain a pair as well as the best, in words.
std::string ambiguity(const Pair& pair, const Hypothesis& best, const std::vector<Hypothesis>& rivals) {
  const Matrix3d& T = best.T_target_source;
  Matrix3d motion = Matrix3d::Identity();
  const Hypothesis* strongest = &rivals.front();
  for (const Hypothesis& rival : rivals) {
    const Matrix3d from_best = rival.T_target_source * inverse(T);
    if (std::abs(yaw_of(from_best)) > std::abs(yaw_of(motion))) motion = from_best;
    if (rival.surprisal > strongest->surprisal) strongest = &rival;
  }
  const Eigen::Matrix2d turn = Eigen::Matrix2d::Identity() - motion.topLeftCorner<2, 2>();
  const Vector2d centre = turn.completeOrthogonalDecomposition().solve(motion.topRightCorner<2, 1>());
  std::array<double, kTurns - 1> turned;
  for (int k = 1; k < kTurns; ++k)
    turned[k - 1] = pair.weigh(rotation_about(centre, 2.0 * kPi * k / kTurns) * T).surprisal;
  std::sort(turned.begin(), turned.end());
  const double median = 0.5 * (turned[(kTurns - 1) / 2 - 1] + turned[(kTurns - 1) / 2]);
  if (median > pair.calibration.ambiguity_ratio * best.surprisal)
    return "undetermined in yaw, the ground is round about x " + fixed(centre.x(), 2) + " m, y " +
           fixed(centre.y(), 2) + " m";
  const Matrix3d& rival = strongest->T_target_source;
  return "ambiguous, the pose x " + fixed(rival(0, 2), 2) + " m, y " + fixed(rival(1, 2), 2) + " m, yaw " +
         fixed(yaw_of(rival) * 180.0 / kPi, 0) + " deg fits as well";
}

/// Why the best hypothesis is no loop closure, in words; empty if it is one.
std::string objection_to(const Pair& pair, const Weighed& weighed,
                         const std::optional<Refinement>& refinement) {
  const Calibration& calibration = pair.calibration;
  const Hypothesis& best = weighed.best;
  const Matrix3d& T = best.T_target_source;
  if (!weighed.significant()) return "chance explains it";
  if (weighed.rivals.empty())
    return "weak agreement, correlation below " + number(calibration.min_correlation, 6);
  const double participation =
      participation_at(pair.source_field, pair.target_field, T, calibration.block * pair.length_scale());
  if (participation < calibration.min_participation)
    return "uneven agreement, it rests on " + fixed(100.0 * participation, 0) + "% of the shared ground";
  const double rivalling = weighed.rivalling(calibration);
  std::vector<Hypothesis> equal;
  for (const Hypothesis& rival : weighed.rivals)
    if (rival.surprisal > rivalling && !leads_to(pair, rival.T_target_source, T)) equal.push_back(rival);
  if (!equal.empty()) return ambiguity(pair, best, equal);
  if (!refinement || !pair.same_place(refinement->T_target_source(), T))
    return "undetermined, the refinement converges elsewhere";
  if (refinement->covariance().hasNaN()) return "undetermined, too little ground to determine the pose";
  for (const Matrix3d& slid : refinement->weakest(calibration.min_separation * pair.source.length_scale))
    if (pair.weigh(slid).surprisal > rivalling) return "undetermined, the match slides";
  return "";
}

/// Ten to a power; nobody needs to know by how much it is below 1e-12.
std::string power_of_ten(double exponent) {
  if (exponent < -12) return "below 1e-12";
  if (-3 < exponent && exponent < 6) return number(std::pow(10.0, exponent), 2);
  return "1e" + number(std::nearbyint(exponent), 17);
}

std::string reason(const Weighed& weighed, const std::string& objection, double allowed) {
  const double exponent = (weighed.needed - weighed.best.surprisal) / kLn10 + std::log10(allowed);
  const Agreement& agreement = weighed.best.agreement;
  return (objection.empty() ? "" : objection + ": ") + power_of_ten(exponent) + " false loops expected, " +
         number(allowed, 6) + " allowed; correlation " + fixed(agreement.correlation, 2) + " over " +
         number(agreement.area, 3) + " m^2";
}

template <std::size_t N, typename Matrix>
std::array<double, N> row_major(const Matrix& matrix) {
  std::array<double, N> values;
  for (std::size_t i = 0; i < N; ++i)
    values[i] =
        matrix(static_cast<Eigen::Index>(i) / matrix.cols(), static_cast<Eigen::Index>(i) % matrix.cols());
  return values;
}

Match without_transform(const std::string& reason) {
  Match match{false, reason, {}, {}, {}, {}, kNan, kNan, kNoEvidence, kNan, 0.0};
  match.T_target_source.fill(kNan);
  match.covariance.fill(kNan);
  return match;
}

/// The decision and the pose in SE(3): the best hypothesis's, without covariance, where it is no loop.
Match decided(const Pair& pair, const Weighed& weighed, const std::optional<Refinement>& refinement) {
  const Matrix3d T = refinement ? refinement->T_target_source() : weighed.best.T_target_source;
  const PlanarPrecision precision =
      refinement ? PlanarPrecision{refinement->pivot(), refinement->covariance()}
                 : PlanarPrecision{transform(T, pair.source_field.centre), Matrix3d::Constant(kNan)};
  const Overlay shared = overlay(pair.source, pair.target, T, refinement ? 1 : kRejectedStep);
  const Anchored source{pair.source, local_origin(pair.source)},
      target{pair.target, local_origin(pair.target)};
  const Lifted lifted = lift_to_se3(source, target, shared, T, precision, pair.calibration);
  Match match{};
  match.accepted = refinement.has_value();
  match.T_target_source = row_major<16>(lifted.T_target_source);
  match.covariance = row_major<36>(lifted.covariance);
  match.source_origin = row_major<3>(source.local_origin);
  match.target_origin = row_major<3>(target.local_origin);
  match.correlation = weighed.best.agreement.correlation;
  match.area = weighed.best.agreement.area;
  match.score = weighed.rivals.empty() ? kNoEvidence : -weighed.log_nfa();
  match.log_nfa = weighed.log_nfa();
  match.overlap = shared.overlap;
  return match;
}

}  // namespace

Match match(const GradientMapView& source, const GradientMapView& target, const MatchSettings& settings) {
  check_map(source, "source");
  check_map(target, "target");
  check_settings(settings);
  const Calibration& calibration = settings.calibration;
  const Pair pair(source, target, calibration);
  if (pair.found.tried == 0.0) {
    const double area = calibration.min_shared_area * std::pow(pair.length_scale(), 2);
    return without_transform("too little ground: an overlap of " + number(area, 3) +
                             " m^2 at a length scale of " + number(pair.length_scale(), 2) + " m is needed");
  }
  const auto first = static_cast<std::size_t>(calibration.dense_hypotheses);
  std::vector<Hypothesis> hypotheses = pair.propose(0, first);
  if (hypotheses.empty())
    return without_transform("featureless: the ground has no structure that could agree");
  Weighed weighed = weigh(pair, hypotheses, settings);
  std::optional<Refinement> refinement;
  if (weighed.significant()) {  // any other place may be a rival
    const std::vector<Hypothesis> others = pair.propose(first, pair.found.poses.size());
    hypotheses.insert(hypotheses.end(), others.begin(), others.end());
    weighed = weigh(pair, hypotheses, settings);
    refinement = Refinement::of(source, target, weighed.best.T_target_source, calibration, kThorough);
  }
  const std::string objection = objection_to(pair, weighed, refinement);
  if (!objection.empty()) refinement.reset();
  Match found = decided(pair, weighed, refinement);
  found.reason = reason(weighed, objection, settings.max_false_loops);
  return found;
}

}  // namespace terrainloop
