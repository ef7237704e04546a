// Broken and degenerate input to every public function: an answer or a std exception, and nothing that a
// sanitizer objects to (.ci/run builds these tests with those for addresses and undefined behaviour).
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <functional>
#include <limits>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "matching/search.hpp"
#include "terrainloop/field.hpp"
#include "terrainloop/gp.hpp"
#include "terrainloop/inliers.hpp"
#include "terrainloop/likelihood.hpp"
#include "terrainloop/refine.hpp"
#include "terrainloop/surf.hpp"

namespace terrainloop {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kTiny = std::numeric_limits<double>::denorm_min();
constexpr double kHuge = std::numeric_limits<double>::max();

struct Cloud {
  std::string name;
  std::vector<double> xy, elevation;
  bool finite = true;
};

Cloud scattered(const std::string& name, int count, double width, double height) {
  std::mt19937 engine(4);
  std::uniform_real_distribution<double> uniform(-0.5, 0.5);
  Cloud cloud{name, {}, {}};
  for (int i = 0; i < count; ++i) {
    cloud.xy.insert(cloud.xy.end(), {width * uniform(engine), width * uniform(engine)});
    cloud.elevation.push_back(height * uniform(engine));
  }
  return cloud;
}

std::vector<Cloud> hostile_clouds() {
  std::vector<Cloud> clouds = {
      {"none", {}, {}},
      {"one point", {1, 2}, {3}},
      {"one point at the end of the numbers", {kHuge, -kHuge}, {kHuge}},
      scattered("flat", 200, 5.0, 0.0),
      scattered("all in one place", 200, 0.0, 1.0),
      scattered("all equal", 200, 0.0, 0.0),
      scattered("denormal", 200, 1e-310, 1e-310),
      scattered("enormous elevations", 200, 5.0, 1e300),
      scattered("enormous extent", 200, 1e300, 1.0),
      {"a line", {}, {}},
  };
  for (int i = 0; i < 200; ++i) {
    clouds.back().xy.insert(clouds.back().xy.end(), {0.05 * i, 0.0});
    clouds.back().elevation.push_back(0.0);
  }
  for (const double far : {1e3, 1e12, kHuge}) {
    clouds.push_back(scattered("a stray point at " + std::to_string(far), 200, 5.0, 1.0));
    clouds.back().xy[7] = far;
  }
  for (const double bad : {kNan, kInf, -kInf})
    for (const bool in_elevation : {false, true}) {
      clouds.push_back(scattered("not a number", 200, 5.0, 1.0));
      (in_elevation ? clouds.back().elevation : clouds.back().xy)[11] = bad;
      clouds.back().finite = false;
    }
  return clouds;
}

/// An answer, or one of the two exceptions; if `refused`, std::invalid_argument.
void expect_answer(const std::string& what, bool refused, const std::function<void()>& call) {
  try {
    call();
    EXPECT_FALSE(refused) << what;
  } catch (const std::invalid_argument&) {
  } catch (const std::runtime_error&) {
    EXPECT_FALSE(refused) << what;
  }
}

gp::Maps maps_of(std::array<std::vector<float>, 5>& maps, std::size_t count) {
  for (std::vector<float>& map : maps) map.assign(count, 0.0f);
  return {maps[0].data(), maps[1].data(), maps[2].data(), maps[3].data(), maps[4].data()};
}

TEST(HostileInput, ToThePosterior) {
  std::array<std::vector<float>, 5> maps;
  const std::vector<double> queries = {0, 0, 1e9, -1e9, kHuge, kHuge, -kHuge, kTiny};
  for (const Cloud& cloud : hostile_clouds()) {
    const bool refused = !cloud.finite || cloud.elevation.empty();
    const std::vector<double> noises(cloud.elevation.size(), 0.1);
    const gp::Points points{cloud.xy.data(), cloud.elevation.data(), noises.data(), noises.size()};
    expect_answer(cloud.name, refused, [&] {
      gp::predict_grid(points, {1.0, 1.0}, {-1.0, -1.0, 0.5, 4, 5}, maps_of(maps, 20), 2);
    });
    expect_answer(cloud.name, refused,
                  [&] { gp::predict_at(points, {1.0, 1.0}, queries.data(), 4, maps_of(maps, 4), 2); });
  }
}

TEST(HostileInput, ToTheModel) {
  std::array<std::vector<float>, 5> maps;
  const Cloud cloud = scattered("usual", 50, 2.0, 1.0);
  const std::vector<double> noises(50, 0.1);
  const gp::Points points{cloud.xy.data(), cloud.elevation.data(), noises.data(), 50};
  const std::vector<double> numbers = {kNan, kInf, -1.0, 0.0, kTiny, 1e-160, 1e160, kHuge, 1.0};
  for (const double length_scale : numbers)
    for (const double variance : numbers) {
      const bool refused = !(length_scale > 0) || !(variance > 0) || std::isinf(length_scale * variance);
      expect_answer("model", refused && !std::isfinite(length_scale + variance), [&] {
        gp::predict_grid(points, {length_scale, variance}, {0, 0, 0.5, 4, 5}, maps_of(maps, 20));
      });
    }
  for (const double noise : {1e-200, 1e-100, 1e100, 1e200}) {
    const std::vector<double> odd(50, noise);
    expect_answer("noise", false, [&] {
      gp::predict_grid({points.xy, points.elevation, odd.data(), 50}, {1.0, 1.0}, {0, 0, 0.5, 4, 5},
                       maps_of(maps, 20));
    });
  }
  for (const double number : numbers) {
    expect_answer("resolution", !(number > 0 && std::isfinite(number)),
                  [&] { gp::predict_grid(points, {1.0, 1.0}, {0, 0, number, 4, 5}, maps_of(maps, 20)); });
    expect_answer("origin", !std::isfinite(number), [&] {
      gp::predict_grid(points, {1.0, 1.0}, {number, -number, 0.5, 4, 5}, maps_of(maps, 20));
    });
    std::vector<double> uneven = noises;
    uneven[3] = number;
    expect_answer("noise", !(number > 0 && std::isfinite(number)), [&] {
      gp::predict_grid({points.xy, points.elevation, uneven.data(), 50}, {1.0, 1.0}, {0, 0, 0.5, 4, 5},
                       maps_of(maps, 20));
    });
  }
}

TEST(HostileInput, ToTheNoiseRatio) {
  for (const Cloud& cloud : hostile_clouds())
    for (const double cell : {0.5, kTiny, kHuge, 0.0, -1.0, kNan, kInf}) {
      std::vector<double> ratio(cloud.elevation.size(), 0.0);
      const bool refused = !cloud.finite || cloud.elevation.empty() || !(cell > 0.0 && std::isfinite(cell));
      expect_answer(cloud.name, refused, [&] {
        gp::noise_ratio(cloud.xy.data(), cloud.elevation.data(), ratio.size(), cell, 0.0, ratio.data(), 2);
        for (const double value : ratio) EXPECT_GT(value, 0.0) << cloud.name;
      });
    }
}

TEST(HostileInput, OneFarPointDoesNotCountInTheNoiseRatio) {
  Cloud cloud = scattered("usual", 2000, 5.0, 0.1);
  std::vector<double> ratio(2000), with_stray(2001);
  gp::noise_ratio(cloud.xy.data(), cloud.elevation.data(), 2000, 0.5, 0.0, ratio.data());
  // Along both axes, so that there are 10^11 cells; the corner of the cells stays where it is.
  cloud.xy.insert(cloud.xy.end(), {2e5, 2e5});
  cloud.elevation.push_back(0.0);
  gp::noise_ratio(cloud.xy.data(), cloud.elevation.data(), 2001, 0.5, 0.0, with_stray.data());
  with_stray.pop_back();
  EXPECT_EQ(with_stray, ratio);
}

TEST(HostileInput, ToTheLikelihood) {
  EXPECT_THROW(gp::BlockLikelihood({}, {1.0, 1.0}, 0.1, 4.0, 1e7), std::invalid_argument);
  for (const Cloud& cloud : hostile_clouds())
    for (const double noise : {1.0, 1e-200, 1e200}) {
      const std::vector<double> noises(cloud.elevation.size(), noise);
      const gp::Points points{cloud.xy.data(), cloud.elevation.data(), noises.data(), noises.size()};
      expect_answer(cloud.name, !cloud.finite || cloud.elevation.empty(), [&] {
        const gp::BlockLikelihood likelihood({points}, {1.0, 1.0}, 0.1, 4.0, 1e6, 2);
        likelihood({1.0, 1.0}, 0.1);
      });
    }
  const Cloud cloud = scattered("usual", 50, 2.0, 1.0);
  const std::vector<double> noises(50, 1.0);
  const std::vector<gp::Points> points = {{cloud.xy.data(), cloud.elevation.data(), noises.data(), 50}};
  const gp::BlockLikelihood likelihood(points, {1.0, 1.0}, 0.1, 4.0, 1e7);
  for (const double bad : {kNan, kInf, -1.0, 0.0}) {
    EXPECT_THROW(likelihood({bad, 1.0}, 0.1), std::invalid_argument);
    EXPECT_THROW(likelihood({1.0, bad}, 0.1), std::invalid_argument);
    EXPECT_THROW(likelihood({1.0, 1.0}, bad), std::invalid_argument);
    EXPECT_THROW(gp::BlockLikelihood(points, {bad, 1.0}, 0.1, 4.0, 1e6), std::invalid_argument);
    EXPECT_THROW(gp::BlockLikelihood(points, {1.0, 1.0}, 0.1, bad, 1e6), std::invalid_argument);
    EXPECT_THROW(gp::BlockLikelihood(points, {1.0, 1.0}, 0.1, 4.0, bad), std::invalid_argument);
  }
  for (const double odd : {kTiny, 1e-160, 1e160, kHuge}) {
    expect_answer("length scale", false, [&] { likelihood({odd, 1.0}, 0.1); });
    expect_answer("variance", false, [&] { likelihood({1.0, odd}, 0.1); });
    expect_answer("noise", false, [&] { likelihood({1.0, 1.0}, odd); });
    expect_answer("about", false, [&] { gp::BlockLikelihood(points, {odd, 1.0}, 0.1, 4.0, 1e6); });
    expect_answer("about", false, [&] { gp::BlockLikelihood(points, {1.0, odd}, odd, 4.0, 1e6); });
    expect_answer("side", false, [&] { gp::BlockLikelihood(points, {1.0, 1.0}, 0.1, odd, 1e6); });
    expect_answer("work", false, [&] { gp::BlockLikelihood(points, {1.0, 1.0}, 0.1, 4.0, odd); });
  }
}

std::vector<float> image(int count, float height = 1.0f) {
  std::mt19937 engine(5);
  std::normal_distribution<float> normal(0.0f, height);
  std::vector<float> pixels(count);
  for (float& pixel : pixels) pixel = normal(engine);
  return pixels;
}

TEST(HostileInput, ToSurf) {
  std::vector<float> pixels = image(40 * 40);
  const ImageView<float> good{pixels.data(), 40, 40};
  const std::vector<std::uint8_t> mask(40 * 40, 1);
  for (const float extreme : {1e-45f, 1e38f}) {
    const std::vector<float> scaled = image(40 * 40, extreme);
    bool finite = true;
    for (const float value : scaled) finite = finite && std::isfinite(value);
    expect_answer("height", !finite, [&] { surf::extract({scaled.data(), 40, 40}, {}, {}); });
  }
  for (const auto& [rows, cols] : {std::pair{0, 0}, {0, 5}, {5, 0}, {1, 1}, {1, 40}, {40, 1}}) {
    EXPECT_TRUE(surf::extract({pixels.data(), rows, cols}, {}, {}).keypoints.empty());
    EXPECT_EQ(surf::fast_hessian({pixels.data(), rows, cols}, 9).size(), std::size_t(rows) * cols);
  }
  EXPECT_THROW(surf::extract({pixels.data(), -1, 40}, {}, {}), std::invalid_argument);
  EXPECT_THROW(surf::extract({nullptr, 40, 40}, {}, {}), std::invalid_argument);
  EXPECT_THROW(surf::extract(good, {mask.data(), 40, 39}, {}), std::invalid_argument);
  for (const surf::Settings& bad :
       {surf::Settings{kNan}, {-1.0}, {0.0, 0}, {0.0, 40}, {0.0, 4, 2}, {0.0, 4, 99}})
    EXPECT_THROW(surf::extract(good, {}, bad), std::invalid_argument);
  for (const int size : {-9, 0, 3, 10, 20})
    EXPECT_THROW(surf::fast_hessian(good, size), std::invalid_argument);
  EXPECT_EQ(surf::fast_hessian(good, 2147483643).size(), 1600u);
  for (const double bad : {kNan, kInf}) {
    pixels[5] = static_cast<float>(bad);
    EXPECT_THROW(surf::extract(good, {}, {}), std::invalid_argument);
    EXPECT_THROW(surf::fast_hessian(good, 9), std::invalid_argument);
  }
}

TEST(HostileInput, ToTheRotationOfAField) {
  std::vector<float> pixels = image(20 * 20), out(3 * 20 * 20);
  const ImageView<float> good{pixels.data(), 20, 20}, narrow{pixels.data(), 20, 19}, none{nullptr, 20, 20};
  const Lookup same = {1, 0, 0, 0, 1, 0};
  EXPECT_THROW(turn_field(good, narrow, good, same, 20, 20, out.data()), std::invalid_argument);
  EXPECT_THROW(turn_field(good, good, none, same, 20, 20, out.data()), std::invalid_argument);
  EXPECT_THROW(turn_field(good, good, good, same, -1, 20, out.data()), std::invalid_argument);
  EXPECT_THROW(turn_field(good, good, good, {0, 0, 0, 0, 0, 0}, 20, 20, out.data()), std::invalid_argument);
  for (const double bad : {kNan, kInf})
    for (std::size_t i = 0; i < same.size(); ++i) {
      Lookup lookup = same;
      lookup[i] = bad;
      EXPECT_THROW(turn_field(good, good, good, lookup, 20, 20, out.data()), std::invalid_argument);
    }
  for (const double odd : {kTiny, -1e-3, 1e5, 1e12, kHuge, -kHuge})
    for (std::size_t i = 0; i < same.size(); ++i) {
      Lookup lookup = same;
      lookup[i] = odd;
      turn_field(good, good, good, lookup, 20, 20, out.data());
    }
  turn_field({}, {}, {}, same, 20, 20, out.data());
  turn_field(good, good, good, same, 0, 20, out.data());
  for (float& pixel : pixels) pixel = static_cast<float>(kNan);
  turn_field(good, good, good, same, 20, 20, out.data());
}

TEST(HostileInput, ToTheCountOfInliers) {
  std::vector<double> places = {0, 0, 1, 1, 2, 2}, motions = {1, 0, 0, 0, kNan, kInf, kHuge, -kHuge};
  std::vector<int> counts(2, -1);
  count_inliers(places.data(), places.data(), 3, motions.data(), 2, 0.5, counts.data());
  EXPECT_EQ(counts, (std::vector<int>{3, 0}));
  places[2] = kNan;
  count_inliers(places.data(), places.data(), 3, motions.data(), 2, kHuge, counts.data());
  EXPECT_EQ(counts[0], 2);
  count_inliers(nullptr, nullptr, 0, motions.data(), 2, 0.5, counts.data());
  EXPECT_EQ(counts, (std::vector<int>{0, 0}));
  count_inliers(places.data(), places.data(), 3, nullptr, 0, 0.5, nullptr);
  for (const double radius : {kNan, 0.0, -1.0})
    EXPECT_THROW(count_inliers(places.data(), places.data(), 3, motions.data(), 2, radius, counts.data()),
                 std::invalid_argument);
}

struct Slopes {
  std::vector<float> x = image(30 * 30, 0.3f), y = image(30 * 30, 0.2f),
                     variance = std::vector<float>(900, 0.01f);
  std::vector<std::uint8_t> mask = std::vector<std::uint8_t>(900, 1);

  refine::Gradients map(int rows = 30, int cols = 30) const {
    return {{x.data(), rows, cols},
            {y.data(), rows, cols},
            {variance.data(), rows, cols},
            {mask.data(), rows, cols},
            0.0,
            0.0,
            0.1};
  }
};

constexpr refine::Motion kStill{1, 0, 0, 0};
constexpr refine::Settings kSettings{1, 500, 5, 1e-6};

TEST(HostileInput, ToTheRefinement) {
  const Slopes good;
  for (const auto& [rows, cols] : {std::pair{0, 0}, {0, 30}, {30, 0}, {1, 30}, {2, 2}})
    for (const int step : {1, 7, 2147483647}) {
      EXPECT_FALSE(refine::settle(good.map(rows, cols), good.map(), kStill, {step, 500, 5, 1e-6}));
      EXPECT_FALSE(refine::settle(good.map(), good.map(rows, cols), kStill, {step, 500, 5, 1e-6}));
    }
  refine::Gradients uneven = good.map();
  uneven.y.cols = 29;
  EXPECT_THROW(refine::settle(uneven, good.map(), kStill, kSettings), std::invalid_argument);
  for (const refine::Settings& bad : {refine::Settings{0, 9, 9, 0.1}, {1, 0, 9, 0.1}, {1, 9, -1, 0.1}})
    EXPECT_THROW(refine::settle(good.map(), good.map(), kStill, bad), std::invalid_argument);
  for (const double bad : {kNan, kInf}) {
    EXPECT_THROW(refine::settle(good.map(), good.map(), {1, 0, bad, 0}, kSettings), std::invalid_argument);
    EXPECT_THROW(refine::settle(good.map(), good.map(), {bad, 0, 0, 0}, kSettings), std::invalid_argument);
    refine::Gradients map = good.map();
    map.resolution = bad;
    EXPECT_THROW(refine::settle(map, good.map(), kStill, kSettings), std::invalid_argument);
    map = good.map();
    map.origin_x = bad;
    EXPECT_THROW(refine::settle(good.map(), map, kStill, kSettings), std::invalid_argument);
  }
  for (const double odd : {kTiny, 1e-9, 1e9, kHuge, -kHuge}) {
    expect_answer("shift", false, [&] { refine::settle(good.map(), good.map(), {1, 0, odd, 0}, kSettings); });
    expect_answer("scale", false, [&] { refine::settle(good.map(), good.map(), {odd, 0, 0, 0}, kSettings); });
    refine::Gradients map = good.map();
    map.resolution = std::abs(odd);
    expect_answer("resolution", false, [&] { refine::settle(good.map(), map, kStill, kSettings); });
    expect_answer("resolution", false, [&] { refine::settle(map, good.map(), kStill, kSettings); });
  }
}

TEST(HostileInput, ToTheImagesOfTheRefinement) {
  const Slopes good;
  for (const float value : {0.0f, -1.0f, 1e-45f, 3e38f, static_cast<float>(kNan), static_cast<float>(kInf)}) {
    Slopes variance, slope;
    variance.variance.assign(900, value);
    slope.x.assign(900, value);
    slope.y.assign(900, value);
    const bool finite = std::isfinite(value);
    expect_answer("variance", !finite || value <= 0.0f,
                  [&] { refine::settle(variance.map(), variance.map(), kStill, kSettings); });
    expect_answer("variance", !finite,
                  [&] { refine::settle(good.map(), variance.map(), kStill, kSettings); });
    expect_answer("slope", !finite, [&] { refine::settle(slope.map(), slope.map(), kStill, kSettings); });
    expect_answer("slope", !finite, [&] { refine::settle(good.map(), slope.map(), kStill, kSettings); });
  }
  Slopes unknown;
  unknown.mask.assign(900, 0);
  EXPECT_FALSE(refine::settle(unknown.map(), good.map(), kStill, kSettings));
}

TEST(HostileInput, ToTheSearch) {
  using search::kLanes;
  std::vector<float> pixels = image(kLanes * 2 * 8 * 8);
  for (const int size : {-4, 0, 7, 14, 20000, 2147483647})
    EXPECT_THROW(search::conjugate_spectra(pixels.data(), 1, 4, size), std::invalid_argument) << size;
  EXPECT_THROW(search::conjugate_spectra(pixels.data(), 1, 9, 8), std::invalid_argument);
  EXPECT_THROW(search::conjugate_spectra(pixels.data(), -1, 8, 8), std::invalid_argument);
  EXPECT_TRUE(search::conjugate_spectra(nullptr, 0, 0, 8).empty());

  for (const float height : {0.0f, 1.0f, 1e-30f, 1e30f, static_cast<float>(kNan), static_cast<float>(kInf)}) {
    const std::vector<float> fields(kLanes * 2 * 2 * 8 * 5, height), ground(kLanes * 2 * 2 * 4 * 3, height);
    const search::TurnedSpectra source{fields.data(), ground.data(), 1};
    const search::StoredSpectra stored{fields.data(), ground.data()};
    search::correlate(source, stored, 8, 1.0, 2.0);
    search::correlate(source, stored, 8, 0.0, 0.0);
    for (const int size : {-4, 0, 6, 7, 28, 2147483644})
      EXPECT_THROW(search::correlate(source, stored, size, 1.0, 2.0), std::invalid_argument) << size;
    for (const double bad : {kNan, -1.0}) {
      EXPECT_THROW(search::correlate(source, stored, 8, bad, 2.0), std::invalid_argument);
      EXPECT_THROW(search::correlate(source, stored, 8, 1.0, bad), std::invalid_argument);
    }
  }
}

}  // namespace
}  // namespace terrainloop
