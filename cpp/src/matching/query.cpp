#include "query.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "fft.hpp"

namespace terrainloop::matching {
namespace {

constexpr double kMostRotations = 2048;  // some times those of the largest field; memory grows with them

/// Multiples of 4 without prime factors beyond 5, at most a quarter apart: Python's FFT_SIZES.
constexpr int kSizes[] = {32, 40, 48, 60, 64, 80, 96, 120, 128, 160, 192, 240, 256, 320, 384, 480};

/// Two images of one shape summed over 2 x 2 pixels.
struct Halved {
  int rows, cols;
  std::vector<float> first, second;

  Halved(const float* one, const float* other, int height, int width)
      : rows((height + 1) / 2), cols((width + 1) / 2), first(rows * cols), second(rows * cols) {
    for (int row = 0, i = 0; row < height; ++row)
      for (int col = 0; col < width; ++col, ++i) {
        first[row / 2 * cols + col / 2] += one[i];
        second[row / 2 * cols + col / 2] += other[i];
      }
  }
};

std::vector<float> energy_of(const float* x, const float* y, std::size_t pixels) {
  std::vector<float> energy(pixels);
  for (std::size_t i = 0; i < pixels; ++i) energy[i] = x[i] * x[i] + y[i] * y[i];
  return energy;
}

/// Half spectra of two images of one shape, sum of x_j exp(-2 pi i j k / size), one after the other.
std::vector<float> half_spectra(const std::vector<float>& one, const std::vector<float>& other, int rows,
                                int cols, int size) {
  const std::size_t waves = static_cast<std::size_t>(size) * (size / 2 + 1);
  std::vector<float> spectra(4 * waves);
  const auto pixel = [&](int row, int col) {
    const bool inside = row < rows && col < cols;
    const std::size_t i = static_cast<std::size_t>(row) * cols + col;
    return search::Complex{search::Lanes::Constant(inside ? one[i] : 0.0f),
                           search::Lanes::Constant(inside ? other[i] : 0.0f)};
  };
  const auto write = [&](int which, int wave, const search::Complex& value) {
    spectra[2 * (which * waves + wave)] = value.re[0];
    spectra[2 * (which * waves + wave) + 1] = -value.im[0];
  };
  search::ConjugateFft2 fft(size);
  fft(std::max(rows, cols), pixel, write);
  return spectra;
}

/// Images of the rotations: x and y, and the valid area and energy summed over 2 x 2 pixels.
struct RotatedImages {
  int side;
  std::vector<float> fields, area;

  RotatedImages(int side, std::size_t rotations) : side(side) {
    const std::size_t half = (side + 1) / 2;
    fields.resize(rotations * 2 * side * side);
    area.resize(rotations * 2 * half * half);
  }

  /// x, y and valid area (3, side, side) of one rotation.
  void set(std::size_t rotation, const std::vector<float>& images) {
    const std::size_t pixels = images.size() / 3;
    std::copy(images.begin(), images.begin() + 2 * pixels, &fields[rotation * 2 * pixels]);
    const std::vector<float> energy = energy_of(&images[0], &images[pixels], pixels);
    const Halved halved(&images[2 * pixels], energy.data(), side, side);
    const auto out = area.begin() + rotation * 2 * halved.first.size();
    std::copy(halved.second.begin(), halved.second.end(),
              std::copy(halved.first.begin(), halved.first.end(), out));
  }
};

/// Half a turn later every image is upside down and every vector reversed.
void turn_by_half(std::vector<float>& images) {
  const auto pixels = static_cast<std::ptrdiff_t>(images.size() / 3);
  for (std::ptrdiff_t first = 0; first < 3 * pixels; first += pixels)
    std::reverse(images.begin() + first, images.begin() + first + pixels);
  std::for_each(images.begin(), images.begin() + 2 * pixels, [](float& value) { value = -value; });
}

std::size_t rotations_of(const Field& field, const Calibration& calibration) {
  const double arc = 2.0 * search::kPi * field.radius / (calibration.rotation_step * field.spacing);
  if (arc > kMostRotations) throw std::invalid_argument("rotation_step must not be so small");
  return static_cast<std::size_t>(std::ceil(arc / search::kLanes)) * search::kLanes;
}

}  // namespace

int search_size(const Field& source, const Field& target, const Calibration& calibration) {
  const int diameter = source.diameter, extent = std::max(target.rows, target.cols);
  const int padded = static_cast<int>(calibration.wraparound * (diameter + extent));
  const int least = std::max({padded, diameter, extent}) + 1;
  const int* size = std::lower_bound(std::begin(kSizes), std::end(kSizes), least);
  if (size == std::end(kSizes)) throw std::invalid_argument("max_pixels must not be so large");
  return *size;
}

Query query_of(const Field& source, int size, const Calibration& calibration) {
  const int side = source.diameter + 1;
  const std::size_t rotations = rotations_of(source, calibration);
  const Matrix3d pixels_from_metres = source.metres_from_pixels().inverse();
  const Vector2d centre = transform(pixels_from_metres, source.centre);
  Query query{size, std::vector<Matrix3d>(rotations), {}, {}};
  RotatedImages rotated(side, rotations);
  std::vector<float> images(static_cast<std::size_t>(3) * side * side);
  for (std::size_t k = 0; k < rotations; ++k) {
    Matrix3d rotation =
        se2(0.0, 0.0, 2.0 * search::kPi * static_cast<double>(k) / static_cast<double>(rotations));
    rotation.topRightCorner<2, 1>() = Vector2d::Constant((side - 1) / 2.0) - transform(rotation, centre);
    query.poses[k] = rotation * pixels_from_metres;
    if (k >= rotations / 2) continue;
    turn_field(source.image(source.x), source.image(source.y), source.image(source.valid),
               lookup_of(inverse(rotation)), side, side, images.data());
    rotated.set(k, images);
    turn_by_half(images);
    rotated.set(k + rotations / 2, images);
  }
  const int blocks = static_cast<int>(rotations / search::kLanes);
  query.fields = search::conjugate_spectra(rotated.fields.data(), blocks, side, size);
  query.area = search::conjugate_spectra(rotated.area.data(), blocks, (side + 1) / 2, size / 2);
  return query;
}

StoredField stored_field_of(const Field& target, int size) {
  const std::vector<float> energy = energy_of(target.x.data(), target.y.data(), target.x.size());
  const Halved halved(target.valid.data(), energy.data(), target.rows, target.cols);
  return {half_spectra(target.x, target.y, target.rows, target.cols, size),
          half_spectra(halved.first, halved.second, halved.rows, halved.cols, size / 2)};
}

}  // namespace terrainloop::matching
