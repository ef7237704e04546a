#pragma once

#include <vector>

#include "terrainloop/match.hpp"

/// How significant a match is, as terrainloop.matching.significance in Python: a-contrario, by the number of
/// false alarms (NFA) that chance yields (Desolneux, Moisan and Morel, Int. J. Comput. Vis. 40(1), 2000). The
/// surprisal of an observation is minus the natural logarithm of its probability by chance, in nats.
namespace terrainloop::matching {

/// Of the correlation r of independent samples of zero mean, which is exceeded with a probability that falls
/// as (1 - r^2)^((n - 1) / 2).
double surprisal_of_correlation(double correlation_squared, double samples, const Calibration& calibration);

/// Of the agreement of two fields: that of the correlation, with the calibrated tail.
double surprisal_of_field(double correlation, double samples, const Calibration& calibration);

/// Natural logarithm of the number of independent tests among the poses that a search tried, from their
/// number and the surprisals of the distinct peaks, falling. If k peaks besides the best reach a surprisal s,
/// it is as if k exp(s) tests had been made.
double log_num_tests(double tried, const std::vector<double>& surprisals, const Calibration& calibration);

}  // namespace terrainloop::matching
