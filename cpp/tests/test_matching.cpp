#include <gtest/gtest.h>

#include <cmath>
#include <complex>
#include <random>
#include <tuple>
#include <vector>

#include "matching/fft.hpp"
#include "matching/search.hpp"
#include "terrainloop/field.hpp"
#include "terrainloop/inliers.hpp"
#include "terrainloop/refine.hpp"

namespace terrainloop {
namespace {

using search::kLanes;
using Number = std::complex<double>;

std::vector<float> noise(std::size_t count, unsigned seed) {
  std::mt19937 draw(seed);
  std::normal_distribution<float> normal;
  std::vector<float> values(count);
  for (float& value : values) value = normal(draw);
  return values;
}

class Fft : public testing::TestWithParam<int> {};

TEST_P(Fft, IsTheSum) {
  const int n = GetParam();
  const std::vector<float> values = noise(2 * kLanes * n, 1);
  std::vector<search::Complex> data(n), scratch(n);
  for (int k = 0; k < n; ++k)
    for (int lane = 0; lane < kLanes; ++lane) {
      data[k].re[lane] = values[2 * (k * kLanes + lane)];
      data[k].im[lane] = values[2 * (k * kLanes + lane) + 1];
    }
  const search::Complex* result = search::InverseFft(n)(data.data(), scratch.data());
  for (int lane = 0; lane < kLanes; ++lane)
    for (int j = 0; j < n; ++j) {
      Number sum = 0;
      for (int k = 0; k < n; ++k)
        sum += Number(values[2 * (k * kLanes + lane)], values[2 * (k * kLanes + lane) + 1]) *
               std::polar(1.0, 2 * search::kPi * j * k / n);
      EXPECT_NEAR(result[j].re[lane], sum.real(), 1e-5 * n);
      EXPECT_NEAR(result[j].im[lane], sum.imag(), 1e-5 * n);
    }
}

INSTANTIATE_TEST_SUITE_P(Sizes, Fft, testing::Values(1, 2, 3, 4, 5, 6, 8, 12, 20, 30, 36, 50, 64, 90));

TEST(Fft, RefusesOtherFactors) { EXPECT_THROW(search::InverseFft(14), std::invalid_argument); }

/// Correlations at every shift, one product after the other.
struct Naive {
  std::vector<double> agreement, shared;

  Naive(const float* source, const float* target, const float* known, const float* stored_known, int extent,
        int size, double least)
      : agreement(size * size), shared(size * size) {
    const int n = extent * extent;
    for (int row = 0; row < size; ++row)
      for (int col = 0; col < size; ++col) {
        double product = 0, energy = 0, other = 0, both = 0;
        for (int r = 0; r < extent; ++r)
          for (int q = 0; q < extent; ++q) {
            const int to_row = (r + row) % size, to_col = (q + col) % size;
            if (to_row >= extent || to_col >= extent) continue;
            const int a = r * extent + q, b = to_row * extent + to_col;
            product += source[a] * target[b] + source[n + a] * target[n + b];
            energy += known[a] * (target[b] * target[b] + target[n + b] * target[n + b]);
            other += stored_known[b] * (source[a] * source[a] + source[n + a] * source[n + a]);
            both += known[a] * stored_known[b];
          }
        shared[row * size + col] = both;
        const bool enough = both > least;
        agreement[row * size + col] = enough ? product * std::abs(product) / (energy * other) * both : 0.0;
      }
  }
};

/// Half spectra (size x (size / 2 + 1), interleaved) of images of an extent, by the sum.
std::vector<float> half_spectra(const std::vector<float>& images, int extent, int size) {
  std::vector<float> spectra;
  for (std::size_t image = 0; image < images.size() / (extent * extent); ++image)
    for (int k = 0; k < size; ++k)
      for (int l = 0; l <= size / 2; ++l) {
        Number sum = 0;
        for (int r = 0; r < extent; ++r)
          for (int q = 0; q < extent; ++q)
            sum += static_cast<double>(images[(image * extent + r) * extent + q]) *
                   std::polar(1.0, -2 * search::kPi * (k * r + l * q) / size);
        spectra.insert(spectra.end(), {static_cast<float>(sum.real()), static_cast<float>(sum.imag())});
      }
  return spectra;
}

/// Images (K, extent, extent) summed over 2 x 2 pixels.
std::vector<float> coarser(const std::vector<float>& images, int extent) {
  const int half = extent / 2;
  std::vector<float> sums(images.size() / 4);
  for (std::size_t i = 0; i < images.size(); ++i) {
    const std::size_t image = i / (extent * extent), row = i / extent % extent, col = i % extent;
    sums[(image * half + row / 2) * half + col / 2] += images[i];
  }
  return sums;
}

TEST(Correlate, IsTheNaiveLoop) {
  constexpr int extent = 16, size = 24, n = extent * extent;
  const double least = 40, evident = 2;
  std::vector<float> fields, ground;
  for (int rotation = 0; rotation < kLanes; ++rotation) {
    std::vector<float> field = noise(2 * n, 10 + rotation), known(n);
    for (int i = 0; i < n; ++i) known[i] = i / extent + i % extent > rotation ? 1.0f : 0.0f;
    for (int i = 0; i < 2 * n; ++i) field[i] *= known[i % n];
    fields.insert(fields.end(), field.begin(), field.end());
    ground.insert(ground.end(), known.begin(), known.end());
    for (int i = 0; i < n; ++i) ground.push_back(field[i] * field[i] + field[n + i] * field[n + i]);
  }
  const std::vector<float> stored = noise(2 * n, 99);
  std::vector<float> stored_ground(n, 1.0f);
  for (int i = 0; i < n; ++i) stored_ground.push_back(stored[i] * stored[i] + stored[n + i] * stored[n + i]);

  const std::vector<float> field_spectra = search::conjugate_spectra(fields.data(), 1, extent, size);
  const std::vector<float> ground_spectra =
      search::conjugate_spectra(coarser(ground, extent).data(), 1, extent / 2, size / 2);
  const std::vector<float> stored_spectra = half_spectra(stored, extent, size);
  const std::vector<float> coarse_spectra =
      half_spectra(coarser(stored_ground, extent), extent / 2, size / 2);
  const search::Correlations found =
      search::correlate({field_spectra.data(), ground_spectra.data(), 1},
                        {stored_spectra.data(), coarse_spectra.data()}, size, least, evident);
  std::size_t peaks = 0;
  for (int rotation = 0; rotation < kLanes; ++rotation) {
    const Naive naive(&fields[rotation * 2 * n], stored.data(), &ground[rotation * 2 * n],
                      stored_ground.data(), extent, size, least);
    double sum = 0, count = 0;
    for (int i = 0; i < size * size; ++i) {
      sum += std::abs(naive.agreement[i]);
      count += naive.shared[i] > least;
    }
    // Shared ground and energies are interpolated: exact where they are linear, here all but at the rims.
    const double sample = std::max(sum / count, 1.0);
    EXPECT_NEAR(found.admissible[rotation], count, 0.1 * count);
    EXPECT_NEAR(found.sample[rotation], sample, 0.05 * sample);
    for (const search::Pose& pose : found.evident) {
      if (pose.rotation != rotation) continue;
      ++peaks;
      const int at = pose.row * size + pose.column;
      const double squared = naive.agreement[at] / naive.shared[at];
      EXPECT_NEAR(pose.squared_correlation, squared, 0.3 * squared);
      EXPECT_NEAR(pose.samples, naive.shared[at] / sample, 0.1 * naive.shared[at] / sample);
    }
  }
  EXPECT_GT(peaks, 20u);
}

TEST(TurnField, TurnsVectorsAlong) {
  constexpr int side = 40;
  std::vector<float> x(side * side), y(side * side), known(side * side, 1.0f), out(3 * side * side);
  const auto field = [](double col, double row) {
    return std::make_pair(std::sin(0.2 * col + 0.1 * row), std::cos(0.15 * row));
  };
  for (int row = 0; row < side; ++row)
    for (int col = 0; col < side; ++col) std::tie(x[row * side + col], y[row * side + col]) = field(col, row);
  known[20 * side + 20] = 0.0f;
  const double c = std::cos(0.3), s = std::sin(0.3), right = 4.0, down = -3.0;
  turn_field({x.data(), side, side}, {y.data(), side, side}, {known.data(), side, side},
             {c, s, right, -s, c, down}, side, side, out.data());
  int inside = 0;
  for (int row = 0; row < side; ++row)
    for (int col = 0; col < side; ++col) {
      const double q = c * col + s * row + right, r = -s * col + c * row + down;
      const float* at = &out[row * side + col];
      if (q < -1 || r < -1 || q > side || r > side || std::hypot(q - 20, r - 20) < 0.4) {
        EXPECT_EQ(at[2 * side * side], 0.0f);
        EXPECT_EQ(at[0], 0.0f);
      } else if (q > 2 && r > 2 && q < side - 3 && r < side - 3 && std::hypot(q - 20, r - 20) > 1) {
        const auto [u, v] = field(q, r);
        EXPECT_EQ(at[2 * side * side], 1.0f);
        EXPECT_NEAR(at[0], c * u - s * v, 0.02);
        EXPECT_NEAR(at[side * side], s * u + c * v, 0.02);
        ++inside;
      }
    }
  EXPECT_GT(inside, 500);
}

TEST(CountInliers, CountsThoseBroughtTogether) {
  const std::vector<double> source = {0, 0, 1, 0, 0, 2, 5, 5}, target = {3, 1, 3, 2, 1, 1, 9, 9};
  const std::vector<double> motions = {0, 1, 3, 1, 1, 0, 0, 0, 1, 0, 3, 1};  // a quarter turn; none; a shift
  std::vector<int> counts(3);
  count_inliers(source.data(), target.data(), 4, motions.data(), 3, 0.1, counts.data());
  EXPECT_EQ(counts, (std::vector<int>{3, 0, 1}));
}

/// Gradients of a surface of a few waves, on a grid in a frame that a motion takes into the surface's own.
struct Surface {
  std::vector<float> x, y, variance;
  std::vector<std::uint8_t> mask;

  refine::Gradients seen(const refine::Motion& m, int side, double resolution) {
    for (int row = 0; row < side; ++row)
      for (int col = 0; col < side; ++col) {
        const double a = m.c * col * resolution - m.s * row * resolution + m.x;
        const double b = m.s * col * resolution + m.c * row * resolution + m.y;
        const double u = 0.3 * std::cos(1.3 * a + 0.4 * b) + 0.1 * std::sin(0.7 * a * b / 4);
        const double v = 0.2 * std::sin(1.7 * b - 0.3 * a) + 0.1 * std::cos(a - b);
        x.push_back(static_cast<float>(m.c * u + m.s * v));
        y.push_back(static_cast<float>(-m.s * u + m.c * v));
      }
    variance.assign(x.size(), 0.01f);
    mask.assign(x.size(), 1);
    const auto image = [side](const auto& values) {
      return ImageView<std::decay_t<decltype(values[0])>>{values.data(), side, side};
    };
    return {image(x), image(y), image(variance), image(mask), 0.0, 0.0, resolution};
  }
};

TEST(Settle, FindsTheMotion) {
  const double yaw = 0.5;
  const refine::Motion true_motion{std::cos(yaw), std::sin(yaw), 1.0, -0.7};
  Surface a, b;
  const refine::Gradients source = a.seen(true_motion, 100, 0.1), target = b.seen({1, 0, 0, 0}, 90, 0.11);
  const refine::Motion start{std::cos(yaw + 0.02), std::sin(yaw + 0.02), 1.1, -0.8};
  const auto found = refine::settle(source, target, start, {2, 1000, 10, 1e-6});
  ASSERT_TRUE(found);
  EXPECT_NEAR(std::atan2(found->motion.s, found->motion.c), yaw, 1e-3);
  EXPECT_NEAR(found->motion.x, 1.0, 5e-3);
  EXPECT_NEAR(found->motion.y, -0.7, 5e-3);
  EXPECT_LE(found->ground.size() / 2, 1000u);

  const refine::Motion far{1, 0, 100, 0};
  EXPECT_FALSE(refine::settle(source, target, far, {2, 1000, 10, 1e-6}));
}

}  // namespace
}  // namespace terrainloop
