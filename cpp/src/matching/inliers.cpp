#include "terrainloop/inliers.hpp"

#include <limits>
#include <stdexcept>
#include <vector>

namespace terrainloop {

void count_inliers(const double* source, const double* target, std::size_t count, const double* motions,
                   std::size_t motion_count, double radius, int* inliers) {
  if (!(radius > 0.0)) throw std::invalid_argument("the radius must be positive");
  if (count > static_cast<std::size_t>(std::numeric_limits<int>::max()))
    throw std::invalid_argument("there must be fewer than 2^31 associations");
  std::vector<double> x(count), y(count), u(count), v(count);  // separate, so that the loop is vectorised
  for (std::size_t i = 0; i < count; ++i) {
    x[i] = source[2 * i];
    y[i] = source[2 * i + 1];
    u[i] = target[2 * i];
    v[i] = target[2 * i + 1];
  }
  for (std::size_t m = 0; m < motion_count; ++m) {
    const double c = motions[4 * m], s = motions[4 * m + 1], dx = motions[4 * m + 2], dy = motions[4 * m + 3];
    int within = 0;
    for (std::size_t i = 0; i < count; ++i) {
      const double away_x = c * x[i] - s * y[i] + dx - u[i], away_y = s * x[i] + c * y[i] + dy - v[i];
      within += away_x * away_x + away_y * away_y <= radius * radius;
    }
    inliers[m] = within;
  }
}

}  // namespace terrainloop
