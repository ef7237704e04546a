#include <gtest/gtest.h>

#include <random>
#include <vector>

#include "integral_image.hpp"

namespace terrainloop {
namespace {

std::vector<float> random_pixels(int count) {
  std::mt19937 engine(7);
  std::vector<float> pixels(count);
  for (float& pixel : pixels) pixel = static_cast<float>(engine() % 1000) - 500.0f;
  return pixels;
}

TEST(IntegralImage, BoxIsTheSumOfItsPixels) {
  constexpr int kRows = 7, kCols = 11;
  const std::vector<float> pixels = random_pixels(kRows * kCols);
  const ImageView<float> image{pixels.data(), kRows, kCols};
  const IntegralImage integral(image);
  for (int row0 = 0; row0 <= kRows; ++row0) {
    for (int row1 = row0; row1 <= kRows; ++row1) {
      for (int col0 = 0; col0 <= kCols; ++col0) {
        for (int col1 = col0; col1 <= kCols; ++col1) {
          double sum = 0.0;
          for (int row = row0; row < row1; ++row) {
            for (int col = col0; col < col1; ++col) sum += image(row, col);
          }
          ASSERT_EQ(integral.box(row0, col0, row1, col1), sum);  // integers: exact
        }
      }
    }
  }
}

TEST(IntegralImage, LargeOffsetCostsNoPrecision) {
  std::vector<float> pixels(1000 * 1000, 1e6f);
  pixels.back() = 1e6f + 1.0f;
  const IntegralImage integral({pixels.data(), 1000, 1000});
  EXPECT_EQ(integral.box(999, 999, 1000, 1000), 1e6 + 1.0);
}

}  // namespace
}  // namespace terrainloop
