#include "fast_hessian.hpp"

#include <Eigen/Dense>
#include <cmath>
#include <optional>

namespace terrainloop::surf {
namespace {

constexpr double kSigmaPerFilterSize = 1.2 / 9.0;  // section 3.3: the 9 x 9 filter approximates sigma = 1.2
constexpr double kDxyWeight = 0.9;                 // section 3.2, equation 3

struct Hessian {
  double xx, yy, xy;

  double determinant() const { return xx * yy - kDxyWeight * kDxyWeight * xy * xy; }
};

/// Box approximations of the Gaussian second derivatives at a pixel, divided by the filter's area (figure 2).
Hessian hessian(const IntegralImage& integral, int row, int col, int size) {
  const int lobe = size / 3, half = size / 2, inner = lobe / 2;
  const double per_area = 1.0 / (static_cast<double>(size) * size);
  const double xx = integral.box(row - lobe + 1, col - half, row + lobe, col + half + 1) -
                    3.0 * integral.box(row - lobe + 1, col - inner, row + lobe, col + inner + 1);
  const double yy = integral.box(row - half, col - lobe + 1, row + half + 1, col + lobe) -
                    3.0 * integral.box(row - inner, col - lobe + 1, row + inner + 1, col + lobe);
  const double xy = integral.box(row - lobe, col - lobe, row, col) +
                    integral.box(row + 1, col + 1, row + lobe + 1, col + lobe + 1) -
                    integral.box(row - lobe, col + 1, row, col + lobe + 1) -
                    integral.box(row + 1, col - lobe, row + lobe + 1, col);
  return {xx * per_area, yy * per_area, xy * per_area};
}

/// Responses of one filter at every step-th pixel; 0 within `margin` samples of the border.
struct Layer {
  int size, step, rows, cols, margin;
  std::vector<double> values;

  double operator()(int i, int j) const { return values[static_cast<std::size_t>(i) * cols + j]; }
};

Layer make_layer(const IntegralImage& integral, int size, int step) {
  Layer layer{size, step, (integral.rows() + step - 1) / step, (integral.cols() + step - 1) / step, 0, {}};
  layer.margin = (size / 2 + step - 1) / step;
  layer.values.assign(static_cast<std::size_t>(layer.rows) * layer.cols, 0.0);
  for (int row = layer.margin * step; row < integral.rows() - size / 2; row += step) {
    double* values = &layer.values[static_cast<std::size_t>(row / step) * layer.cols];
    for (int j = layer.margin; j * step < integral.cols() - size / 2; ++j) {
      values[j] = hessian(integral, row, j * step, size).determinant();
    }
  }
  return layer;
}

/// Filter sizes 9, 15, 21, 27; 15, 27, 39, 51; 27, 51, 75, 99; ... (section 3.3, figure 5).
std::vector<Layer> make_octave(const IntegralImage& integral, int octave, int intervals) {
  std::vector<Layer> layers;
  for (int k = 0; k < intervals; ++k) {
    layers.push_back(make_layer(integral, 3 * ((2 << octave) * (k + 1) + 1), 1 << octave));
  }
  return layers;
}

/// A sample of an octave and its neighbours in scale (k), row (i) and column (j).
struct Neighbourhood {
  const std::vector<Layer>& octave;
  int k, i, j;

  double at(int dk, int di, int dj) const { return octave[k + dk](i + di, j + dj); }

  /// No neighbour exceeds the sample. Of equal ones the first in scan order wins, so that a blob centred
  /// between two samples is found, once.
  bool is_maximum() const {
    const double value = at(0, 0, 0);
    for (int n = 0; n < 27; ++n) {
      const double neighbour = at(n / 9 - 1, n / 3 % 3 - 1, n % 3 - 1);
      if (neighbour > value || (neighbour == value && n < 13)) return false;
    }
    return true;
  }

  Eigen::Vector3d gradient() const {  // central differences over (column, row, scale), in samples
    return 0.5 * Eigen::Vector3d(at(0, 0, 1) - at(0, 0, -1), at(0, 1, 0) - at(0, -1, 0),
                                 at(1, 0, 0) - at(-1, 0, 0));
  }

  Eigen::Matrix3d curvature() const {
    const double twice = 2.0 * at(0, 0, 0);
    const double xy = 0.25 * (at(0, 1, 1) - at(0, 1, -1) - at(0, -1, 1) + at(0, -1, -1));
    const double xs = 0.25 * (at(1, 0, 1) - at(1, 0, -1) - at(-1, 0, 1) + at(-1, 0, -1));
    const double ys = 0.25 * (at(1, 1, 0) - at(1, -1, 0) - at(-1, 1, 0) + at(-1, -1, 0));
    Eigen::Matrix3d result;
    result << at(0, 0, 1) - twice + at(0, 0, -1), xy, xs,  //
        xy, at(0, 1, 0) - twice + at(0, -1, 0), ys,        //
        xs, ys, at(1, 0, 0) - twice + at(-1, 0, 0);
    return result;
  }
};

/// Keypoint at the peak of the quadratic through the neighbourhood (section 3.4; Brown & Lowe, BMVC 2002).
/// None where the peak is beyond the neighbours: the fit is not valid there.
std::optional<Keypoint> refine(const IntegralImage& integral, const Neighbourhood& sample) {
  const Eigen::Vector3d gradient = sample.gradient();
  const Eigen::Vector3d offset = -sample.curvature().fullPivLu().solve(gradient);
  if (!(offset.cwiseAbs().maxCoeff() < 1.0)) return std::nullopt;
  const Layer& layer = sample.octave[sample.k];
  const int growth = sample.octave[1].size - sample.octave[0].size;
  const Hessian h = hessian(integral, sample.i * layer.step, sample.j * layer.step, layer.size);
  return Keypoint{(sample.j + offset.x()) * layer.step,
                  (sample.i + offset.y()) * layer.step,
                  (layer.size + offset.z() * growth) * kSigmaPerFilterSize,
                  0.0,
                  sample.at(0, 0, 0) + 0.5 * gradient.dot(offset),
                  h.xx + h.yy > 0.0 ? 1 : -1};
}

bool allowed(ImageView<std::uint8_t> mask, const Keypoint& keypoint) {
  if (!mask.data) return true;
  return mask(static_cast<int>(std::lround(keypoint.y)), static_cast<int>(std::lround(keypoint.x))) != 0;
}

void detect_in_layer(const IntegralImage& integral, ImageView<std::uint8_t> mask, double threshold,
                     const std::vector<Layer>& octave, int k, std::vector<Keypoint>& keypoints) {
  const Layer& layer = octave[k];
  // All 27 samples must come from filters that fit the image, the next larger ones too.
  const int margin = octave[k + 1].margin + 1;
  const int last_row = (integral.rows() - 1 - octave[k + 1].size / 2) / layer.step - 1;
  const int last_col = (integral.cols() - 1 - octave[k + 1].size / 2) / layer.step - 1;
  for (int i = margin; i <= last_row; ++i) {
    for (int j = margin; j <= last_col; ++j) {
      if (!(layer(i, j) > threshold)) continue;
      const Neighbourhood sample{octave, k, i, j};
      if (!sample.is_maximum()) continue;
      const auto keypoint = refine(integral, sample);
      if (keypoint && allowed(mask, *keypoint)) keypoints.push_back(*keypoint);
    }
  }
}

}  // namespace

std::vector<Keypoint> detect(const IntegralImage& integral, ImageView<std::uint8_t> mask,
                             const Settings& settings) {
  std::vector<Keypoint> keypoints;
  for (int o = 0; o < settings.octaves; ++o) {
    const std::vector<Layer> octave = make_octave(integral, o, settings.intervals);
    for (int k = 1; k + 1 < settings.intervals; ++k) {
      detect_in_layer(integral, mask, settings.threshold, octave, k, keypoints);
    }
  }
  return keypoints;
}

std::vector<double> response_map(const IntegralImage& integral, int filter_size) {
  return make_layer(integral, filter_size, 1).values;
}

}  // namespace terrainloop::surf
