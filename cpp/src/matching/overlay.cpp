#include "overlay.hpp"

#include <algorithm>
#include <cmath>

#include "interpolate.hpp"

namespace terrainloop::matching {
namespace {

constexpr float kWhole = 0.999f;  // of observed ground

double observed_area(const GradientMapView& map) {
  double count = 0.0;
  const std::size_t pixels = static_cast<std::size_t>(map.mask.rows) * map.mask.cols;
  for (std::size_t i = 0; i < pixels; ++i) count += map.mask.data[i];
  return count * map.resolution * map.resolution;
}

Matrix3d metres_of(const GradientMapView& map) {
  return metres_from_pixels(map.origin_x, map.origin_y, map.resolution);
}

/// Calls visit(pixel of the target, x, y of the source there, x, y of the target) where both are observed.
template <typename Visit>
void for_shared_pixels(const Field& source, const Field& target, const Matrix3d& T_target_source,
                       const Visit& visit) {
  const Matrix3d lookup =
      source.metres_from_pixels().inverse() * inverse(T_target_source) * target.metres_from_pixels();
  const std::size_t pixels = target.x.size();
  std::vector<float> images(3 * pixels);
  turn_field(source.image(source.x), source.image(source.y), source.image(source.valid), lookup_of(lookup),
             target.rows, target.cols, images.data());
  for (std::size_t i = 0; i < pixels; ++i)
    if (images[2 * pixels + i] > 0 && target.valid[i] > 0)
      visit(i, images[i], images[pixels + i], target.x[i], target.y[i]);
}

}  // namespace

Overlay overlay(const GradientMapView& source, const GradientMapView& target, const Matrix3d& T_target_source,
                int step) {
  const Matrix3d lookup = metres_of(source).inverse() * inverse(T_target_source) * metres_of(target);
  const Lookup rows = lookup_of(lookup);
  Overlay shared{};
  for (int row = 0; row < target.mask.rows; row += step)
    for (int col = 0; col < target.mask.cols; col += step) {
      const Place at(rows, col, row);
      if (!target.mask(row, col) || !(bilinear(source.mask, at) > kWhole)) continue;
      shared.positions.insert(shared.positions.end(), {target.origin_x + col * target.resolution,
                                                       target.origin_y + row * target.resolution});
      shared.source_elevation.push_back(bilinear(source.elevation, at));
      shared.target_elevation.push_back(target.elevation(row, col));
      shared.slope.insert(shared.slope.end(), {target.gradient_x(row, col), target.gradient_y(row, col)});
    }
  const double pixel = std::pow(step * target.resolution, 2);
  const double area = static_cast<double>(shared.source_elevation.size()) * pixel;
  if (area > 0.0) shared.overlap = area / (observed_area(source) + observed_area(target) - area);
  return shared;
}

Agreement agreement_at(const Field& source, const Field& target, const Matrix3d& T_target_source) {
  double product = 0.0, energy = 0.0, other = 0.0, count = 0.0;
  for_shared_pixels(source, target, T_target_source,
                    [&](std::size_t, double x, double y, double u, double v) {
                      product += u * x + v * y;
                      energy += x * x + y * y;
                      other += u * u + v * v;
                      count += 1.0;
                    });
  const double scale = std::sqrt(energy * other);
  return {scale > 0.0 ? product / scale : 0.0, count * target.spacing * target.spacing};
}

double participation_at(const Field& source, const Field& target, const Matrix3d& T_target_source,
                        double block) {
  const auto side = static_cast<std::size_t>(std::max(1.0, std::nearbyint(block / target.spacing)));
  const std::size_t across = target.cols / side + 1;
  std::vector<double> sums((target.rows / side + 1) * across), counts(sums.size());
  for_shared_pixels(source, target, T_target_source,
                    [&](std::size_t i, double x, double y, double u, double v) {
                      const std::size_t at = i / target.cols / side * across + i % target.cols / side;
                      sums[at] += u * x + v * y;
                      counts[at] += 1.0;
                    });
  double sum = 0.0, count = 0.0, squares = 0.0;
  for (std::size_t b = 0; b < sums.size(); ++b) {
    sum += sums[b];
    count += counts[b];
    if (counts[b] > 0.0) squares += sums[b] * sums[b] / counts[b];
  }
  return squares > 0.0 ? sum * sum / (count * squares) : 0.0;
}

}  // namespace terrainloop::matching
