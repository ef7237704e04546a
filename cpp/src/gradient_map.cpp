#include "terrainloop/gradient_map.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "median.hpp"

namespace terrainloop {
namespace {

// As terrainloop.gp.training, terrainloop.gp.spline and terrainloop.gradient_map in Python.
constexpr std::size_t kFewestPoints = 100;
constexpr int kPlaneFits = 3;
constexpr double kMaxDeviations = 10.0;  // robust ones from the plane, beyond which a point is no terrain
constexpr double kNormal = 1.4826;       // standard deviations in a median absolute deviation
constexpr double kMinLimit = 1e-3;       // metres; a smaller distance is never an outlier
constexpr double kMaxOutliers = 0.1;     // of the points: more are terrain
constexpr double kNoiseCell = 0.5;       // length scales
constexpr double kMinScatter = 0.1;      // of the noise of the process
constexpr double kPixelsPerLengthScale = 6.0;
constexpr double kMostPixels = 20e6;
constexpr double kFarthest = 1e10;  // metres

using Cloud = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

/// A cloud referred to its centre and the plane through most of its points.
struct Detrended {
  Eigen::Vector3d centre;
  Eigen::Vector2d slope;
  Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor> xy;
  Eigen::VectorXd elevation;
};

/// Rows near the plane that most points are on, by their elevation above it.
std::vector<Eigen::Index> terrain(const Eigen::VectorXd& elevation) {
  std::vector<double> distances(elevation.data(), elevation.data() + elevation.size());
  const double middle = median(distances);
  for (double& distance : distances) distance = std::abs(distance - middle);
  const double limit = std::max(kMaxDeviations * kNormal * median(distances), kMinLimit);
  std::vector<Eigen::Index> rows;
  for (std::size_t i = 0; i < distances.size(); ++i)
    if (distances[i] <= limit) rows.push_back(static_cast<Eigen::Index>(i));
  const bool most =
      static_cast<double>(rows.size()) >= (1.0 - kMaxOutliers) * static_cast<double>(elevation.size());
  if (most) return rows;
  rows.resize(distances.size());
  for (std::size_t i = 0; i < rows.size(); ++i) rows[i] = static_cast<Eigen::Index>(i);
  return rows;
}

/// Points further from the plane than ten robust standard deviations are dropped.
Detrended detrend(Cloud cloud) {
  Detrended result;
  const auto refer = [&] {
    result.xy = cloud.leftCols<2>().rowwise() - result.centre.head<2>().transpose();
    result.elevation = cloud.col(2).array() - result.centre.z();
    result.elevation -= result.xy * result.slope;
  };
  result.slope.setZero();
  result.centre = cloud.colwise().mean().transpose();
  for (int fit = 0; fit < kPlaneFits; ++fit) {
    result.slope.setZero();
    refer();
    const Eigen::Matrix2d normal = result.xy.transpose() * result.xy;
    result.slope = normal.completeOrthogonalDecomposition().solve(result.xy.transpose() * result.elevation);
    result.elevation -= result.xy * result.slope;
    const std::vector<Eigen::Index> kept = terrain(result.elevation);
    if (static_cast<Eigen::Index>(kept.size()) == cloud.rows()) return result;
    cloud = Cloud(cloud(kept, Eigen::all));
    result.centre = cloud.colwise().mean().transpose();
  }
  refer();
  return result;
}

void check(const double* xyz, std::size_t count, const MapSettings& settings) {
  if (count < kFewestPoints) throw std::invalid_argument("a map needs at least 100 points");
  for (std::size_t i = 0; i < 3 * count; ++i)
    if (!(std::abs(xyz[i]) < kFarthest))
      throw std::invalid_argument("points must be finite and below 1e10 m");
  const auto positive = [](double value) { return value > 0.0 && std::isfinite(value); };
  if (!positive(settings.parameters.length_scale) || !positive(settings.parameters.variance) ||
      !positive(settings.noise) || !positive(settings.max_variance_ratio))
    throw std::invalid_argument("hyperparameters, noise and max_variance_ratio must be positive");
  if (!(settings.resolution >= 0.0 && std::isfinite(settings.resolution)))
    throw std::invalid_argument("the resolution must not be negative");
}

/// An empty map over the bounding box of the points.
GradientMap grid_of(const Detrended& data, const MapSettings& settings) {
  const double length_scale = settings.parameters.length_scale;
  const double resolution =
      settings.resolution > 0.0 ? settings.resolution : length_scale / kPixelsPerLengthScale;
  const Eigen::Vector2d centre = data.centre.head<2>();
  const Eigen::Vector2d low = data.xy.colwise().minCoeff().transpose() + centre;
  const Eigen::Vector2d high = data.xy.colwise().maxCoeff().transpose() + centre;
  const Eigen::Array2d size = ((high - low).array() / resolution + 1e-9).floor() + 1.0;
  if (!(size.prod() <= kMostPixels))
    throw std::invalid_argument("the points extend over more than 20 million pixels");
  GradientMap map{static_cast<int>(size.y()),
                  static_cast<int>(size.x()),
                  {},
                  {},
                  {},
                  {},
                  {},
                  {},
                  low.x(),
                  low.y(),
                  resolution,
                  length_scale};
  const std::size_t pixels = static_cast<std::size_t>(map.rows) * map.cols;
  for (std::vector<float>* image :
       {&map.elevation, &map.gradient_x, &map.gradient_y, &map.variance, &map.gradient_variance})
    image->resize(pixels);
  map.mask.resize(pixels);
  return map;
}

void add_plane(GradientMap& map, const Detrended& data) {
  const double left = map.origin_x - data.centre.x(), low = map.origin_y - data.centre.y();
  const float slope_x = static_cast<float>(data.slope.x()), slope_y = static_cast<float>(data.slope.y());
  std::size_t i = 0;
  for (int row = 0; row < map.rows; ++row)
    for (int col = 0; col < map.cols; ++col, ++i) {
      const double x = left + map.resolution * col, y = low + map.resolution * row;
      const double plane = data.centre.z() + data.slope.x() * x + data.slope.y() * y;
      map.elevation[i] = static_cast<float>(map.elevation[i] + plane);
      map.gradient_x[i] += slope_x;
      map.gradient_y[i] += slope_y;
    }
}

}  // namespace

GradientMapView GradientMap::view() const {
  const auto image = [this](const std::vector<float>& pixels) {
    return ImageView<float>{pixels.data(), rows, cols};
  };
  return {image(elevation),
          image(gradient_x),
          image(gradient_y),
          image(gradient_variance),
          {mask.data(), rows, cols},
          origin_x,
          origin_y,
          resolution,
          length_scale};
}

GradientMap make_gradient_map(const double* xyz, std::size_t count, const MapSettings& settings) {
  check(xyz, count, settings);
  const auto& [length_scale, variance] = settings.parameters;
  const Detrended data = detrend(Eigen::Map<const Cloud>(xyz, static_cast<Eigen::Index>(count), 3));
  GradientMap map = grid_of(data, settings);
  std::vector<double> noise(static_cast<std::size_t>(data.elevation.size()));
  gp::noise_ratio(data.xy.data(), data.elevation.data(), noise.size(), kNoiseCell * length_scale,
                  kMinScatter * settings.noise, noise.data(), settings.threads);
  for (double& value : noise) value *= settings.noise;
  const gp::Points points{data.xy.data(), data.elevation.data(), noise.data(), noise.size()};
  const gp::Grid grid{map.origin_x - data.centre.x(), map.origin_y - data.centre.y(), map.resolution,
                      map.rows, map.cols};
  gp::predict_grid(points, settings.parameters, grid,
                   {map.elevation.data(), map.gradient_x.data(), map.gradient_y.data(), map.variance.data(),
                    map.gradient_variance.data()},
                   settings.threads);
  add_plane(map, data);
  const float largest = static_cast<float>(settings.max_variance_ratio * variance);
  for (std::size_t i = 0; i < map.mask.size(); ++i) map.mask[i] = map.variance[i] < largest;
  return map;
}

}  // namespace terrainloop
