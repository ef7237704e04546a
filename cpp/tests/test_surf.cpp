#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "terrainloop/surf.hpp"

namespace terrainloop::surf {
namespace {

constexpr int kSide = 121;

std::vector<float> blob(double x, double y, double sigma, double height = 1.0) {
  std::vector<float> pixels;
  for (int row = 0; row < kSide; ++row) {
    for (int col = 0; col < kSide; ++col) {
      const double squared = (col - x) * (col - x) + (row - y) * (row - y);
      pixels.push_back(static_cast<float>(height * std::exp(-0.5 * squared / (sigma * sigma))));
    }
  }
  return pixels;
}

Features extract_all(const std::vector<float>& pixels) {
  return extract({pixels.data(), kSide, kSide}, {}, {1e-3});
}

TEST(Surf, FindsABlobWhereItIs) {
  const Features features = extract_all(blob(60.3, 58.6, 5.0));
  ASSERT_EQ(features.keypoints.size(), 1u);
  EXPECT_NEAR(features.keypoints[0].x, 60.3, 0.1);
  EXPECT_NEAR(features.keypoints[0].y, 58.6, 0.1);
  EXPECT_EQ(features.keypoints[0].laplacian, -1);
}

TEST(Surf, SignOfTheLaplacianTellsDarkFromBright) {
  const Features features = extract_all(blob(60.0, 60.0, 5.0, -1.0));
  ASSERT_EQ(features.keypoints.size(), 1u);
  EXPECT_EQ(features.keypoints[0].laplacian, 1);
}

TEST(Surf, BlobBetweenFourPixelsIsFoundOnce) {
  EXPECT_EQ(extract_all(blob(60.5, 60.5, 5.0)).keypoints.size(), 1u);
}

TEST(Surf, DescriptorHasUnitLength) {
  const Features features = extract_all(blob(60.0, 60.0, 5.0));
  ASSERT_EQ(features.descriptors.size(), 1u);
  double squares = 0.0;
  for (const float value : features.descriptors[0]) squares += static_cast<double>(value) * value;
  EXPECT_NEAR(squares, 1.0, 1e-6);
}

TEST(Surf, MaskForbidsKeypoints) {
  const std::vector<float> pixels = blob(60.0, 60.0, 5.0);
  std::vector<std::uint8_t> mask(kSide * kSide, 1);
  mask[60 * kSide + 60] = 0;
  EXPECT_TRUE(extract({pixels.data(), kSide, kSide}, {mask.data(), kSide, kSide}, {1e-3}).keypoints.empty());
}

TEST(Surf, ImageSmallerThanTheFiltersHasNoKeypoints) {
  const std::vector<float> pixels(5 * 3, 1.0f);
  EXPECT_TRUE(extract({pixels.data(), 5, 3}, {}, {}).keypoints.empty());
}

TEST(FastHessian, IsTheDeterminantOnAParabola) {
  // On z = (x^2 + y^2) / 2 every box filter gives Dxx = Dyy and Dxy = 0. By hand for 9 x 9: rows of 5,
  // columns 3 + 3 + 3, so Dxx = 5 * sum over k in {-1, 0, 1} of ((k + 3)^2 - 2 k^2 + (k - 3)^2) / 2 = 5 * 27.
  std::vector<float> pixels;
  for (int row = 0; row < 9; ++row) {
    for (int col = 0; col < 9; ++col) pixels.push_back(static_cast<float>(0.5 * (row * row + col * col)));
  }
  const std::vector<double> response = fast_hessian({pixels.data(), 9, 9}, 9);
  EXPECT_NEAR(response[4 * 9 + 4], std::pow(5.0 * 27.0 / 81.0, 2), 1e-12);
  EXPECT_EQ(response[0], 0.0);
}

}  // namespace
}  // namespace terrainloop::surf
