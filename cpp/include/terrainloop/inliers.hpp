#pragma once

#include <cstddef>

namespace terrainloop {

/// How many associations (count x 2, each) a rigid motion brings within `radius` of each other, for every
/// motion; one is (cos, sin, x, y). At most 2^31 - 1 associations.
void count_inliers(const double* source, const double* target, std::size_t count, const double* motions,
                   std::size_t motion_count, double radius, int* inliers);

}  // namespace terrainloop
