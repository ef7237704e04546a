#pragma once

#include <cstddef>

namespace terrainloop {

/// Number of associations (count x 2, each) that a rigid motion brings within `radius` of each other, for
/// every motion (cos, sin, x, y). NaN is never an inlier. Throws std::invalid_argument for more than 2^31 - 1
/// associations and for a radius that is not positive.
void count_inliers(const double* source, const double* target, std::size_t count, const double* motions,
                   std::size_t motion_count, double radius, int* inliers);

}  // namespace terrainloop
