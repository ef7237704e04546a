#include "surf_descriptor.hpp"

#include <algorithm>
#include <cmath>

namespace terrainloop::surf {
namespace {

constexpr double kPi = 3.14159265358979323846;

// Section 4.1, in units of the scale. (The ECCV 2006 edition had an orientation sigma of 2.5.)
constexpr int kOrientationRadius = 6;
constexpr double kOrientationSide = 4.0;
constexpr double kOrientationSigma = 2.0;
constexpr double kOrientationWindow = kPi / 3.0;
// Section 4.2, in units of the scale.
constexpr int kSubregions = 4;        // along each side
constexpr int kSubregionSamples = 5;  // along each side
constexpr double kDescriptorSide = 2.0;
constexpr double kDescriptorSigma = 3.3;

struct Response {
  double dx = 0.0, dy = 0.0;
};

/// A coordinate in the integral image: `cell` corners before it, then a fraction of a pixel.
struct Bound {
  int cell;
  double fraction;

  Bound(double pixel, int count) {
    cell = std::min(static_cast<int>(pixel + 0.5), count - 1);
    fraction = pixel + 0.5 - cell;
  }
};

/// Sum over the image above y and left of x, a border pixel counting by the part of its area.
double corner(const IntegralImage& integral, Bound y, Bound x) {
  const double above =
      integral.corner(y.cell, x.cell) * (1.0 - x.fraction) + integral.corner(y.cell, x.cell + 1) * x.fraction;
  const double below = integral.corner(y.cell + 1, x.cell) * (1.0 - x.fraction) +
                       integral.corner(y.cell + 1, x.cell + 1) * x.fraction;
  return above * (1.0 - y.fraction) + below * y.fraction;
}

/// Haar wavelet responses at (x, y), positive where the image grows with x and with y; 0 where the wavelet
/// extends over the border. Bounds are not rounded to pixels, which would bias wavelets of even side.
Response haar(const IntegralImage& integral, double x, double y, double side) {
  const double half = 0.5 * side;
  const int rows = integral.rows(), cols = integral.cols();
  if (x - half < -0.5 || y - half < -0.5 || x + half > cols - 0.5 || y + half > rows - 0.5) return {};
  const Bound left(x - half, cols), centre(x, cols), right(x + half, cols);
  const Bound top(y - half, rows), middle(y, rows), bottom(y + half, rows);
  const double top_left = corner(integral, top, left), top_right = corner(integral, top, right);
  const double bottom_left = corner(integral, bottom, left), bottom_right = corner(integral, bottom, right);
  const double top_row = top_left - 2.0 * corner(integral, top, centre) + top_right;
  const double bottom_row = bottom_left - 2.0 * corner(integral, bottom, centre) + bottom_right;
  const double left_column = top_left - 2.0 * corner(integral, middle, left) + bottom_left;
  const double right_column = top_right - 2.0 * corner(integral, middle, right) + bottom_right;
  return {bottom_row - top_row, right_column - left_column};
}

double gaussian(double u, double v, double sigma) {
  return std::exp(-0.5 * (u * u + v * v) / (sigma * sigma));
}

struct Directed {
  double angle;
  Response response;
};

/// Weighted responses in the circle around (x, y), by angle.
std::vector<Directed> responses_around(const IntegralImage& integral, double x, double y, double scale) {
  std::vector<Directed> responses;
  for (int i = -kOrientationRadius; i <= kOrientationRadius; ++i) {
    for (int j = -kOrientationRadius; j <= kOrientationRadius; ++j) {
      if (i * i + j * j > kOrientationRadius * kOrientationRadius) continue;
      Response response = haar(integral, x + j * scale, y + i * scale, kOrientationSide * scale);
      const double weight = gaussian(i, j, kOrientationSigma);
      response = {weight * response.dx, weight * response.dy};
      responses.push_back({std::atan2(response.dy, response.dx), response});
    }
  }
  std::stable_sort(responses.begin(), responses.end(),
                   [](const Directed& a, const Directed& b) { return a.angle < b.angle; });
  return responses;
}

/// Sum of the responses whose angles are in the window that starts at the first-th.
Response window_sum(const std::vector<Directed>& responses, std::size_t first) {
  Response sum;
  for (std::size_t n = 0; n < responses.size(); ++n) {
    const Directed& next = responses[(first + n) % responses.size()];
    const double turn = next.angle - responses[first].angle;
    if ((turn < 0.0 ? turn + 2.0 * kPi : turn) >= kOrientationWindow) break;
    sum = {sum.dx + next.response.dx, sum.dy + next.response.dy};
  }
  return sum;
}

}  // namespace

double dominant_orientation(const IntegralImage& integral, double x, double y, double scale) {
  const std::vector<Directed> responses = responses_around(integral, x, y, scale);
  Response longest;
  double longest_squared = -1.0;
  for (std::size_t first = 0; first < responses.size(); ++first) {  // every window with different contents
    const Response sum = window_sum(responses, first);
    const double squared = sum.dx * sum.dx + sum.dy * sum.dy;
    if (squared > longest_squared) {
      longest_squared = squared;
      longest = sum;
    }
  }
  return std::atan2(longest.dy, longest.dx);
}

Descriptor describe(const IntegralImage& integral, const Keypoint& keypoint) {
  const double c = std::cos(keypoint.orientation), s = std::sin(keypoint.orientation);
  constexpr int kSamples = kSubregions * kSubregionSamples;
  std::array<double, std::tuple_size<Descriptor>::value> sums{};
  for (int i = 0; i < kSamples; ++i) {
    for (int j = 0; j < kSamples; ++j) {
      const double u = j - 0.5 * (kSamples - 1),
                   v = i - 0.5 * (kSamples - 1);  // along, across the orientation
      const Response response =
          haar(integral, keypoint.x + keypoint.scale * (c * u - s * v),
               keypoint.y + keypoint.scale * (s * u + c * v), kDescriptorSide * keypoint.scale);
      const double weight = gaussian(u, v, kDescriptorSigma);
      const double along = weight * (c * response.dx + s * response.dy);
      const double across = weight * (c * response.dy - s * response.dx);
      double* subregion = &sums[4 * (i / kSubregionSamples * kSubregions + j / kSubregionSamples)];
      subregion[0] += along;
      subregion[1] += across;
      subregion[2] += std::abs(along);
      subregion[3] += std::abs(across);
    }
  }
  double squares = 0.0;
  for (const double sum : sums) squares += sum * sum;
  const double per_length = squares > 0.0 ? 1.0 / std::sqrt(squares) : 0.0;
  Descriptor descriptor;
  std::transform(sums.begin(), sums.end(), descriptor.begin(),
                 [=](double sum) { return static_cast<float>(sum * per_length); });
  return descriptor;
}

}  // namespace terrainloop::surf
