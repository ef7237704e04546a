#include <algorithm>
#include <cmath>
#include <complex>
#include <limits>
#include <vector>

#include "fft.hpp"
#include "gradient_field.hpp"

namespace terrainloop::matching {
namespace {

using Number = std::complex<float>;

/// The smallest size from `least` on without prime factors beyond 5.
int fft_size(int least) {
  for (int size = std::max(least, 1);; ++size) {
    int rest = size;
    for (const int prime : {2, 3, 5})
      while (rest % prime == 0) rest /= prime;
    if (rest == 1) return size;
  }
}

/// A square of n x n complex numbers, transformed in place.
class Plane {
 public:
  explicit Plane(int n)
      : values(static_cast<std::size_t>(n) * n), n_(n), fft_(n), buffer_(2 * n, search::Complex{}) {
    for (search::Complex& number : buffer_) number = {search::Lanes::Zero(), search::Lanes::Zero()};
  }

  /// Sum of z_j exp(2 pi i j k / n) along both axes, unscaled.
  void transform() {
    for (const bool rows : {true, false})
      for (int first = 0; first < n_; first += search::kLanes) transform_lines(first, rows);
  }

  /// The inverse of `transform`.
  void invert() {
    for (Number& value : values) value = std::conj(value);
    transform();
    const float scale = 1.0f / static_cast<float>(values.size());
    for (Number& value : values) value = scale * std::conj(value);
  }

  std::vector<Number> values;

 private:
  void transform_lines(int first, bool rows) {
    const int lines = std::min(search::kLanes, n_ - first);
    const auto at = [&](int line, int k) -> Number& {
      return values[rows ? static_cast<std::size_t>(first + line) * n_ + k
                         : static_cast<std::size_t>(k) * n_ + first + line];
    };
    for (int k = 0; k < n_; ++k)
      for (int line = 0; line < lines; ++line) {
        buffer_[k].re[line] = at(line, k).real();
        buffer_[k].im[line] = at(line, k).imag();
      }
    const search::Complex* transformed = fft_(buffer_.data(), buffer_.data() + n_);
    for (int k = 0; k < n_; ++k)
      for (int line = 0; line < lines; ++line)
        at(line, k) = {transformed[k].re[line], transformed[k].im[line]};
  }

  int n_;
  search::InverseFft fft_;
  std::vector<search::Complex> buffer_;
};

/// The power spectrum of the real and the imaginary part together, smoothed: a product in the lags.
Plane smoothed_power(const Plane& spectrum, int n, double decay) {
  Plane power(n);
  for (int row = 0, i = 0; row < n; ++row)
    for (int col = 0; col < n; ++col, ++i) {
      const Number opposite = spectrum.values[static_cast<std::size_t>((n - row) % n) * n + (n - col) % n];
      power.values[i] = 0.5f * (std::norm(spectrum.values[i]) + std::norm(opposite));
    }
  power.invert();
  std::vector<float> taper(n);
  for (int lag = 0; lag < n; ++lag)
    taper[lag] = static_cast<float>(std::exp(-0.5 * std::pow(decay * std::min(lag, n - lag), 2)));
  for (int row = 0, i = 0; row < n; ++row)
    for (int col = 0; col < n; ++col, ++i) power.values[i] *= taper[row] * taper[col];
  power.transform();
  for (Number& value : power.values) value = std::max(value.real(), 0.0f);
  return power;
}

}  // namespace

void whiten(Field& field, const Calibration& calibration) {
  const int width = std::max(field.rows, field.cols), n = fft_size(2 * width);
  Plane plane(n);
  const auto at = [n](int row, int col) { return static_cast<std::size_t>(row) * n + col; };
  for (int row = 0, i = 0; row < field.rows; ++row)
    for (int col = 0; col < field.cols; ++col, ++i) plane.values[at(row, col)] = {field.x[i], field.y[i]};
  plane.transform();
  const double decay = 2.0 * search::kPi * calibration.spectrum_smoothing / width;
  const Plane power = smoothed_power(plane, n, decay);
  double sum = 0.0;  // over the half that determines the rest
  for (int row = 0; row < n; ++row)
    for (int col = 0; col <= n / 2; ++col) sum += power.values[at(row, col)].real();
  const double mean = sum / n / (n / 2 + 1);
  const float floor =
      std::max(static_cast<float>(calibration.whitening_floor * mean), std::numeric_limits<float>::min());
  // The filter is real and even: it takes x and y, the real and the imaginary part, each to itself.
  for (std::size_t i = 0; i < plane.values.size(); ++i)
    plane.values[i] /= std::sqrt(power.values[i].real() + floor);
  plane.invert();
  for (int row = 0, i = 0; row < field.rows; ++row)
    for (int col = 0; col < field.cols; ++col, ++i) {
      field.x[i] = plane.values[at(row, col)].real() * field.valid[i];
      field.y[i] = plane.values[at(row, col)].imag() * field.valid[i];
    }
}

}  // namespace terrainloop::matching
