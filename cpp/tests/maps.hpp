#pragma once

#include <cmath>
#include <random>
#include <vector>

#include "terrainloop/gradient_map.hpp"

namespace terrainloop {

/// Ground that is a sum of round bumps, known in closed form, and its gradient maps.
class Bumps {
 public:
  explicit Bumps(unsigned seed) {
    std::mt19937 engine(seed);
    std::uniform_real_distribution<double> place(-9.0, 9.0), size(0.2, 0.5);
    std::normal_distribution<double> height(0.0, 0.12);
    for (int i = 0; i < 700; ++i)
      bumps_.push_back({place(engine), place(engine), size(engine), height(engine)});
  }

  /// Elevation and the two slopes.
  void at(double x, double y, double (&values)[3]) const {
    values[0] = values[1] = values[2] = 0.0;
    for (const Bump& bump : bumps_) {
      const double dx = (x - bump.x) / bump.size, dy = (y - bump.y) / bump.size;
      const double height = bump.height * std::exp(-0.5 * (dx * dx + dy * dy));
      values[0] += height;
      values[1] -= height * dx / bump.size;
      values[2] -= height * dy / bump.size;
    }
  }

  /// The map of a frame that is turned by `yaw` and moved by (x, y).
  GradientMap map(double x, double y, double yaw, int rows = 60, int cols = 50) const {
    const std::size_t pixels = static_cast<std::size_t>(rows) * cols;
    GradientMap map{rows,
                    cols,
                    {},
                    {},
                    {},
                    std::vector<float>(pixels, 1e-4f),
                    std::vector<float>(pixels, 6e-4f),
                    std::vector<std::uint8_t>(pixels, 1),
                    -2.0,
                    -2.5,
                    0.08,
                    0.4};
    const double c = std::cos(yaw), s = std::sin(yaw);
    for (int row = 0; row < rows; ++row)
      for (int col = 0; col < cols; ++col) {
        const double u = map.origin_x + map.resolution * col, v = map.origin_y + map.resolution * row;
        double ground[3];
        at(c * u - s * v + x, s * u + c * v + y, ground);
        map.elevation.push_back(static_cast<float>(ground[0]));
        map.gradient_x.push_back(static_cast<float>(c * ground[1] + s * ground[2]));
        map.gradient_y.push_back(static_cast<float>(c * ground[2] - s * ground[1]));
      }
    return map;
  }

 private:
  struct Bump {
    double x, y, size, height;
  };
  std::vector<Bump> bumps_;
};

}  // namespace terrainloop
