#include "terrainloop/refine.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "../image_checks.hpp"
#include "../median.hpp"
#include "interpolate.hpp"

namespace terrainloop::refine {
namespace {

constexpr double kCauchy = 2.5;      // robust standard deviations at which a residual counts half
constexpr std::size_t kFewest = 50;  // samples
constexpr double kNormal = 1.4826;   // standard deviations in a median absolute deviation
constexpr float kWhole = 0.999f;     // of known ground

using Vector = Eigen::Vector2d;

struct Pixel {
  int row, col;  // of every step-th row and column of the target
};

/// Looks up the source at pixels of the target, on every step-th row and column.
class Aligned {
 public:
  Aligned(const Gradients& source, const Gradients& target, const Motion& motion, int step)
      : source_(source), target_(target), motion_(motion), step_(step) {
    const double pixel = step * target.resolution / source.resolution;
    const double x = target.origin_x - motion.x, y = target.origin_y - motion.y;
    lookup_ = {motion.c * pixel,
               motion.s * pixel,
               (motion.c * x + motion.s * y - source.origin_x) / source.resolution,
               -motion.s * pixel,
               motion.c * pixel,
               (motion.c * y - motion.s * x - source.origin_y) / source.resolution};
  }

  /// Pixels that both maps know, with all that are beside them.
  std::vector<Pixel> shared() const {
    const int rows = (target_.mask.rows - 1) / step_ + 1, cols = (target_.mask.cols - 1) / step_ + 1;
    std::vector<char> known(static_cast<std::size_t>(rows) * cols);
    for (int row = 0; row < rows; ++row)
      for (int col = 0; col < cols; ++col)
        known[static_cast<std::size_t>(row) * cols + col] =
            of_target(target_.mask, {row, col}) != 0 &&
            bilinear(source_.mask, Place(lookup_, col, row)) > kWhole;
    std::vector<Pixel> pixels;
    for (int row = 1; row + 1 < rows; ++row)
      for (int col = 1; col + 1 < cols; ++col) {
        const char* at = &known[static_cast<std::size_t>(row) * cols + col];
        bool all = true;
        for (const int down : {-cols, 0, cols}) all = all && at[down - 1] && at[down] && at[down + 1];
        if (all) pixels.push_back({row, col});
      }
    return pixels;
  }

  template <typename T>
  T of_target(const ImageView<T>& image, const Pixel& p) const {
    return image.data[static_cast<std::size_t>(p.row) * step_ * image.cols + p.col * step_];
  }

  /// The source's gradient in the target's axes.
  Vector of_source(const Pixel& p) const {
    const Place at(lookup_, p.col, p.row);
    const double x = bilinear(source_.x, at), y = bilinear(source_.y, at);
    return {motion_.c * x - motion_.s * y, motion_.s * x + motion_.c * y};
  }

  double variance(const Pixel& p) const {
    return of_target(target_.variance, p) + bilinear(source_.variance, Place(lookup_, p.col, p.row));
  }

  Vector observed(const Pixel& p) const { return {of_target(target_.x, p), of_target(target_.y, p)}; }

  double spacing() const { return step_ * target_.resolution; }

  Vector ground(const Pixel& p) const {
    return {target_.origin_x + p.col * spacing(), target_.origin_y + p.row * spacing()};
  }

 private:
  const Gradients &source_, &target_;
  Motion motion_;
  int step_;
  Lookup lookup_;
};

/// Inverse variances times Cauchy's weights of the residuals, and the slope of weight times residual, by
/// which a residual that counts less also holds less information.
void weigh(Linearised& at, const std::vector<double>& variance) {
  const std::size_t count = variance.size();
  std::vector<double> normalised(2 * count);
  for (std::size_t i = 0; i < 2 * count; ++i) normalised[i] = at.residual[i] / std::sqrt(variance[i % count]);
  const double middle = median(normalised);
  std::vector<double> away(normalised);
  for (double& value : away) value = std::abs(value - middle);
  const double half = kCauchy * std::max(kNormal * median(std::move(away)), 1e-12);
  for (std::size_t i = 0; i < 2 * count; ++i) {
    const double kept = 1.0 / (1.0 + std::pow(normalised[i] / half, 2));
    at.weights[i] = kept / variance[i % count];
    at.slopes[i] = at.weights[i] * std::max(2.0 * kept - 1.0, 0.0);
  }
}

std::optional<Linearised> linearise(const Gradients& source, const Gradients& target, const Motion& motion,
                                    const Settings& settings) {
  const Aligned aligned(source, target, motion, settings.step);
  const std::vector<Pixel> shared = aligned.shared();
  if (shared.size() < kFewest) return std::nullopt;
  const std::size_t every = (shared.size() + settings.places - 1) / settings.places;
  const std::size_t count = (shared.size() + every - 1) / every;
  Linearised at{motion,
                0,
                0,
                {},
                std::vector<double>(2 * count),
                std::vector<double>(2 * count),
                std::vector<double>(2 * count),
                std::vector<double>(10 * count)};
  for (std::size_t i = 0; i < count; ++i) {
    const Vector ground = aligned.ground(shared[i * every]);
    at.ground.insert(at.ground.end(), {ground.x(), ground.y()});
    at.pivot_x += ground.x() / static_cast<double>(count);
    at.pivot_y += ground.y() / static_cast<double>(count);
  }
  std::vector<double> variance(count);
  for (std::size_t i = 0; i < count; ++i) {
    const Pixel p = shared[i * every];
    const Vector g = aligned.of_source(p), residual = aligned.observed(p) - g;
    const Vector by_x = (aligned.of_source({p.row, p.col + 1}) - aligned.of_source({p.row, p.col - 1})) /
                        (2 * aligned.spacing());
    const Vector by_y = (aligned.of_source({p.row + 1, p.col}) - aligned.of_source({p.row - 1, p.col})) /
                        (2 * aligned.spacing());
    const double u = at.ground[2 * i] - at.pivot_x, v = at.ground[2 * i + 1] - at.pivot_y;
    // d r / d t = grad g . t; d r / d theta: displacement about the pivot, less the rotation of g itself.
    const Vector by_turn = by_y * u - by_x * v - Vector(-g.y(), g.x());
    variance[i] = aligned.variance(p);
    if (!(variance[i] > 0.0 && std::isfinite(variance[i]) && residual.allFinite()))
      throw std::invalid_argument("masked gradients must be finite, their variances positive");
    for (int k = 0; k < 2; ++k) {
      const std::size_t row = k * count + i;
      at.residual[row] = residual[k];
      const double by_motion[] = {by_x[k], by_y[k], by_turn[k], k == 0 ? -1.0 : 0.0, k == 1 ? -1.0 : 0.0};
      std::copy(by_motion, by_motion + 5, &at.by_motion[5 * row]);
    }
  }
  weigh(at, variance);
  return at;
}

/// One step of Gauss-Newton: the motion further on, and how far that moves the ground, metres.
std::pair<Motion, double> step(const Linearised& at) {
  using Rows = Eigen::Matrix<double, Eigen::Dynamic, 5, Eigen::RowMajor>;
  const Eigen::Index rows = static_cast<Eigen::Index>(at.residual.size());
  const Eigen::Map<const Rows> jacobian(at.by_motion.data(), rows, 5);
  const Eigen::Map<const Eigen::VectorXd> residual(at.residual.data(), rows),
      weights(at.weights.data(), rows);
  const Rows weighted = weights.asDiagonal() * jacobian;
  const Eigen::Matrix<double, 5, 5> normal = weighted.transpose() * jacobian;
  const Eigen::Matrix<double, 5, 1> by =
      -normal.completeOrthogonalDecomposition().solve(weighted.transpose() * residual);
  double square = 0;
  for (std::size_t i = 0; i < at.ground.size(); i += 2)
    square += std::pow(at.ground[i] - at.pivot_x, 2) + std::pow(at.ground[i + 1] - at.pivot_y, 2);
  const double radius = std::sqrt(2 * square / static_cast<double>(at.ground.size()));
  const double c = std::cos(by[2]), s = std::sin(by[2]);
  const Motion& old = at.motion;
  const double x = old.x - at.pivot_x, y = old.y - at.pivot_y;
  return {{c * old.c - s * old.s, s * old.c + c * old.s, c * x - s * y + at.pivot_x + by[0],
           s * x + c * y + at.pivot_y + by[1]},
          std::hypot(by[0], by[1]) + std::abs(by[2]) * radius};
}

void check(const Gradients& map) {
  terrainloop::check(map.x, "x");
  terrainloop::check(map.mask, "mask");
  if (!same_shape(map.x, map.y) || !same_shape(map.x, map.variance) || !same_shape(map.x, map.mask))
    throw std::invalid_argument("gradients, variance and mask must have one shape");
  if (!std::isfinite(map.origin_x) || !std::isfinite(map.origin_y) || !std::isfinite(map.resolution) ||
      !(map.resolution > 0.0))
    throw std::invalid_argument("a map must have a finite origin and a positive resolution");
}

}  // namespace

std::optional<Linearised> settle(const Gradients& source, const Gradients& target, const Motion& motion,
                                 const Settings& settings) {
  check(source);
  check(target);
  if (settings.step < 1 || settings.places < 1 || settings.steps < 0)
    throw std::invalid_argument("step and places must be at least 1, steps 0");
  if (!std::isfinite(motion.c) || !std::isfinite(motion.s) || !std::isfinite(motion.x) ||
      !std::isfinite(motion.y))
    throw std::invalid_argument("the motion must be finite");
  std::optional<Linearised> at = linearise(source, target, motion, settings);
  for (int i = 0; at && i < settings.steps; ++i) {
    const auto [further, moved] = step(*at);
    at = linearise(source, target, further, settings);
    if (moved < settings.tolerance) break;
  }
  return at;
}

}  // namespace terrainloop::refine
