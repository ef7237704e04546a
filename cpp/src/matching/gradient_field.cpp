#include "gradient_field.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "../median.hpp"

namespace terrainloop::matching {
namespace {

constexpr float kTiny = std::numeric_limits<float>::min();

/// Weights of consecutive pixels of a line.
struct Taps {
  int first;
  std::vector<float> weights;
};

/// Low-pass filter and linear interpolation of a line of pixels at every `step` of them, for each result.
std::vector<Taps> resampling(int pixels, double step, double blur) {
  const double sigma = std::max(blur * step, 0.3);
  const int reach = static_cast<int>(std::min(std::nearbyint(8.0 * sigma + 1.0) / 2.0, 1e6));
  const auto gaussian = [&](int d) {
    return std::abs(d) > reach ? 0.0 : std::exp(-0.5 * (d / sigma) * (d / sigma));
  };
  double sum = 0.0;
  for (int d = -reach; d <= reach; ++d) sum += gaussian(d);
  std::vector<Taps> lines(static_cast<std::size_t>(std::ceil((pixels - 1) / step)) + 1);
  for (std::size_t i = 0; i < lines.size(); ++i) {
    const double at = static_cast<double>(i) * step, left = std::min(std::floor(at), pixels * 1.0);
    const int p = static_cast<int>(left);
    const double beyond = at - left, here = p < pixels ? 1.0 - beyond : 0.0;
    const double next = p + 1 < pixels ? beyond : 0.0;
    const int first = std::max(0, p - reach), last = std::min(pixels - 1, p + 1 + reach);
    lines[i].first = first;
    for (int q = first; q <= last; ++q)
      lines[i].weights.push_back(
          static_cast<float>((here * gaussian(q - p) + next * gaussian(q - p - 1)) / sum));
  }
  return lines;
}

/// An image whose pixels are value(index), filtered and resampled along both axes.
template <typename Value>
std::vector<float> resampled(const std::vector<Taps>& down, const std::vector<Taps>& across, int rows,
                             int cols, const Value& value) {
  const std::size_t width = across.size();
  std::vector<float> lines(rows * width), image(down.size() * width);
  std::vector<float> line(cols);
  for (int row = 0; row < rows; ++row) {
    for (int col = 0; col < cols; ++col) line[col] = value(static_cast<std::size_t>(row) * cols + col);
    for (std::size_t col = 0; col < width; ++col) {
      double sum = 0.0;
      for (std::size_t i = 0; i < across[col].weights.size(); ++i)
        sum += static_cast<double>(across[col].weights[i]) * line[across[col].first + i];
      lines[row * width + col] = static_cast<float>(sum);
    }
  }
  for (std::size_t row = 0; row < down.size(); ++row)
    for (std::size_t col = 0; col < width; ++col) {
      double sum = 0.0;
      for (std::size_t i = 0; i < down[row].weights.size(); ++i)
        sum += static_cast<double>(down[row].weights[i]) * lines[(down[row].first + i) * width + col];
      image[row * width + col] = static_cast<float>(sum);
    }
  return image;
}

/// Of each pixel: 0 outside the mask, less where the variance of the gradient is high.
std::vector<float> weights_of(const GradientMapView& map) {
  const std::size_t pixels = static_cast<std::size_t>(map.mask.rows) * map.mask.cols;
  std::vector<double> variances;
  for (std::size_t i = 0; i < pixels; ++i)
    if (map.mask.data[i]) variances.push_back(map.gradient_variance.data[i]);
  const double typical = std::max<double>(variances.empty() ? 0.0 : median(std::move(variances)), kTiny);
  std::vector<float> weights(pixels, 0.0f);
  for (std::size_t i = 0; i < pixels; ++i)
    if (map.mask.data[i])
      weights[i] = static_cast<float>(1.0 / (1.0 + map.gradient_variance.data[i] / typical));
  return weights;
}

double weighted_mean(const ImageView<float>& image, const std::vector<float>& weights) {
  double sum = 0.0, total = 0.0;
  for (std::size_t i = 0; i < weights.size(); ++i) {
    sum += static_cast<double>(weights[i]) * image.data[i];
    total += weights[i];
  }
  return total > 0.0 ? sum / total : 0.0;
}

/// Divides each vector by sqrt(1 + (length / clip)^2), so that no single crest dominates, and by the robust
/// deviation: the search transforms energies and areas together, so they must not differ by much.
void clip(Field& field, const Calibration& calibration) {
  constexpr double kRayleighMedian = 1.1774100225154747;  // of a vector of two standard normal components
  std::vector<double> lengths;
  double largest = 0.0;
  for (std::size_t i = 0; i < field.x.size(); ++i) {
    const double length = std::hypot(field.x[i], field.y[i]);
    largest = std::max(largest, length);
    if (field.valid[i] > 0) lengths.push_back(length);
  }
  const double middle = lengths.empty() ? 0.0 : median(std::move(lengths));
  const double robust = std::max({middle / kRayleighMedian, 1e-6 * largest, static_cast<double>(kTiny)});
  for (std::size_t i = 0; i < field.x.size(); ++i) {
    const double excess = std::hypot(field.x[i], field.y[i]) / (calibration.clip * robust);
    const double divisor = robust * std::sqrt(1.0 + excess * excess);
    field.x[i] = static_cast<float>(field.x[i] / divisor);
    field.y[i] = static_cast<float>(field.y[i] / divisor);
  }
}

/// Centroid, radius and diameter of the observed area.
void measure(Field& field) {
  std::vector<Vector2d> positions;
  for (int row = 0, i = 0; row < field.rows; ++row)
    for (int col = 0; col < field.cols; ++col, ++i)
      if (field.valid[i] > 0) positions.emplace_back(col, row);  // pixels
  const Vector2d origin(field.origin_x, field.origin_y);
  field.centre = origin;
  if (positions.empty()) return;
  Vector2d middle = Vector2d::Zero();
  for (const Vector2d& p : positions) middle += p / static_cast<double>(positions.size());
  double square = 0.0, farthest = 0.0;
  for (const Vector2d& p : positions) {
    square += (p - middle).squaredNorm();
    farthest = std::max(farthest, (p - middle).norm());
  }
  field.centre = origin + field.spacing * middle;
  field.radius = field.spacing * std::sqrt(square / static_cast<double>(positions.size()));
  field.diameter = static_cast<int>(std::ceil(2.0 * farthest)) + 4;
}

}  // namespace

double field_spacing(const GradientMapView& map, const Calibration& calibration) {
  const double spacing = map.length_scale / calibration.pixels_per_length_scale;
  const double width = std::max(map.mask.rows, map.mask.cols) * map.resolution;
  return spacing * std::exp2(std::max(0.0, std::ceil(std::log2(width / (calibration.max_pixels * spacing)))));
}

Field field_of(const GradientMapView& map, double spacing, const Calibration& calibration) {
  const int rows = map.mask.rows, cols = map.mask.cols;
  const double step = spacing / map.resolution;
  const std::vector<Taps> down = resampling(rows, step, calibration.blur);
  const std::vector<Taps> across = resampling(cols, step, calibration.blur);
  const std::vector<float> weights = weights_of(map);
  const auto average = [&](const ImageView<float>& image) {
    const float mean = static_cast<float>(weighted_mean(image, weights));
    return resampled(down, across, rows, cols,
                     [&](std::size_t i) { return (image.data[i] - mean) * weights[i]; });
  };
  Field field{static_cast<int>(down.size()),
              static_cast<int>(across.size()),
              average(map.gradient_x),
              average(map.gradient_y),
              resampled(down, across, rows, cols, [&](std::size_t i) { return 1.0f * map.mask.data[i]; }),
              map.origin_x,
              map.origin_y,
              spacing,
              map.length_scale};
  for (std::size_t i = 0; i < field.valid.size(); ++i) {
    const float observed = field.valid[i], share = observed > 0.5f ? 1.0f / observed : 0.0f;
    field.x[i] *= share;
    field.y[i] *= share;
    field.valid[i] = observed > 0.5f ? 1.0f : 0.0f;
  }
  measure(field);
  whiten(field, calibration);
  clip(field, calibration);
  return field;
}

}  // namespace terrainloop::matching
