#include "terrainloop/inliers.hpp"

#include <Eigen/Core>

namespace terrainloop {

void count_inliers(const double* source, const double* target, std::size_t count, const double* motions,
                   std::size_t motion_count, double radius, int* inliers) {
  using Coordinates = Eigen::Map<const Eigen::ArrayXd, 0, Eigen::InnerStride<2>>;
  const Eigen::Index n = static_cast<Eigen::Index>(count);
  const Eigen::ArrayXd x = Coordinates(source, n), y = Coordinates(source + 1, n);
  const Eigen::ArrayXd u = Coordinates(target, n), v = Coordinates(target + 1, n);
  for (std::size_t m = 0; m < motion_count; ++m) {
    const double c = motions[4 * m], s = motions[4 * m + 1], dx = motions[4 * m + 2], dy = motions[4 * m + 3];
    int within = 0;
    for (Eigen::Index i = 0; i < n; ++i) {
      const double away_x = c * x[i] - s * y[i] + dx - u[i], away_y = s * x[i] + c * y[i] + dy - v[i];
      within += away_x * away_x + away_y * away_y <= radius * radius;
    }
    inliers[m] = within;
  }
}

}  // namespace terrainloop
