#include "significance.hpp"

#include <algorithm>
#include <cmath>

namespace terrainloop::matching {

double surprisal_of_correlation(double correlation_squared, double samples, const Calibration& calibration) {
  const double bounded = std::min(correlation_squared, std::pow(calibration.max_correlation, 2));
  return -0.5 * std::max(samples - 1.0, 0.0) * std::log1p(-bounded);
}

double surprisal_of_field(double correlation, double samples, const Calibration& calibration) {
  const double squared = std::pow(std::max(correlation, 0.0), 2);
  return calibration.tail * surprisal_of_correlation(squared, samples, calibration);
}

double log_num_tests(double tried, const std::vector<double>& surprisals, const Calibration& calibration) {
  const double others = static_cast<double>(surprisals.size()) - 1.0;
  const double measured = others >= 1.0 ? calibration.tail * surprisals.back() + std::log(others) : 0.0;
  return std::max(std::log(std::max(calibration.independent_tests * tried, 1.0)), measured);
}

}  // namespace terrainloop::matching
