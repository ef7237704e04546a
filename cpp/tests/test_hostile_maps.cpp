// Broken and degenerate maps and points, as test_hostile_input.cpp has them for the other functions.
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "maps.hpp"
#include "terrainloop/match.hpp"

namespace terrainloop {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
constexpr double kInf = std::numeric_limits<double>::infinity();
constexpr double kTiny = std::numeric_limits<double>::denorm_min();
constexpr double kHuge = std::numeric_limits<double>::max();

const GradientMap kMap = Bumps(1).map(0.0, 0.0, 0.0, 40, 40);

using Change = std::function<void(GradientMap&)>;

/// As source and as target: a decision, or std::invalid_argument if `refused`.
void expect(bool refused, const std::string& what, const Change& change, const MatchSettings& settings = {}) {
  GradientMap changed = kMap;
  change(changed);
  const GradientMapView view = changed.view(), good = kMap.view();
  if (refused) {
    EXPECT_THROW(match(view, good, settings), std::invalid_argument) << what;
    EXPECT_THROW(match(good, view, settings), std::invalid_argument) << what;
  } else {
    for (const Match& found : {match(view, good, settings), match(good, view, settings)})
      EXPECT_FALSE(found.reason.empty()) << what;
  }
}

TEST(HostileMaps, NumbersThatAreNoGroundAreRefused) {
  for (const float bad : {static_cast<float>(kNan), static_cast<float>(kInf), 2e12f}) {
    expect(true, "elevation", [&](GradientMap& m) { m.elevation[17] = bad; });
    expect(true, "gradient x", [&](GradientMap& m) { m.gradient_x[17] = bad; });
    expect(true, "gradient y", [&](GradientMap& m) { m.gradient_y[17] = -bad; });
    expect(true, "gradient variance", [&](GradientMap& m) { m.gradient_variance[17] = bad; });
    expect(true, "outside the mask", [&](GradientMap& m) {
      m.mask[17] = 0;
      m.gradient_x[17] = bad;
    });
  }
  for (const float bad : {0.0f, -1.0f}) {
    expect(true, "variance", [&](GradientMap& m) { m.gradient_variance[17] = bad; });
    expect(false, "variance outside the mask", [&](GradientMap& m) {
      m.mask[17] = 0;
      m.gradient_variance[17] = bad;
    });
  }
  expect(true, "mask", [](GradientMap& m) { m.mask[17] = 255; });
}

TEST(HostileMaps, GridsThatAreNoneAreRefused) {
  for (const double bad : {kNan, kInf, -kInf, kHuge}) {
    expect(true, "origin", [&](GradientMap& m) { m.origin_x = bad; });
    expect(true, "origin", [&](GradientMap& m) { m.origin_y = -bad; });
  }
  for (const double bad : {kNan, kInf, 0.0, -1.0, kTiny, kHuge}) {
    expect(true, "resolution", [&](GradientMap& m) { m.resolution = bad; });
    expect(true, "length scale", [&](GradientMap& m) { m.length_scale = bad; });
  }
  for (const auto& [rows, cols] : {std::pair{0, 0}, {0, 40}, {40, 0}, {-40, 40}, {39, 40}, {2147483647, 9}}) {
    GradientMapView uneven = kMap.view();
    uneven.mask.rows = rows;
    uneven.mask.cols = cols;
    EXPECT_THROW(match(uneven, kMap.view()), std::invalid_argument) << rows;
    EXPECT_THROW(match(kMap.view(), uneven), std::invalid_argument) << rows;
  }
  GradientMapView none = kMap.view();
  none.gradient_y.data = nullptr;
  EXPECT_THROW(match(none, kMap.view()), std::invalid_argument);
  EXPECT_THROW(match({}, {}), std::invalid_argument);
}

TEST(HostileMaps, ExtremesAreDecided) {
  for (const double far : {1e3, 1e7, 1e12, -1e12})
    expect(false, "far away", [&](GradientMap& m) { m.origin_x = m.origin_y = far; });
  for (const float scale : {0.0f, 1e-45f, 1e-30f, 1e-10f, 1e10f, 1e11f})
    expect(false, "slopes", [&](GradientMap& m) {
      for (std::vector<float>* image : {&m.gradient_x, &m.gradient_y, &m.elevation})
        for (float& value : *image) value *= scale;
    });
  for (const float variance : {1e-45f, 1e-30f, 1e12f})
    expect(false, "variance", [&](GradientMap& m) { m.gradient_variance.assign(1600, variance); });
  for (const double scale : {1e-9, 1e-3, 1e3, 1e9})
    expect(false, "scale", [&](GradientMap& m) {
      m.resolution *= scale;
      m.length_scale *= scale;
    });
  for (const double length_scale : {0.1, 10.0, 700.0})
    expect(false, "length scale", [&](GradientMap& m) { m.length_scale = length_scale; });
}

TEST(HostileMaps, DegenerateMasksAreDecided) {
  expect(false, "nothing", [](GradientMap& m) { m.mask.assign(1600, 0); });
  expect(false, "one pixel", [](GradientMap& m) {
    m.mask.assign(1600, 0);
    m.mask[820] = 1;
  });
  expect(false, "a line", [](GradientMap& m) {
    for (int i = 0; i < 1600; ++i) m.mask[i] = i / 40 == 20;
  });
  expect(false, "every other pixel", [](GradientMap& m) {
    for (int i = 0; i < 1600; ++i) m.mask[i] = (i / 40 + i) % 2;
  });
  for (const auto& [rows, cols] : {std::pair{1, 1}, {1, 1600}, {1600, 1}, {2, 3}, {800, 2}}) {
    const GradientMap odd = Bumps(1).map(0.0, 0.0, 0.0, rows, cols);
    EXPECT_FALSE(match(odd.view(), kMap.view()).reason.empty());
    EXPECT_FALSE(match(kMap.view(), odd.view()).reason.empty());
    EXPECT_FALSE(match(odd.view(), odd.view()).reason.empty());
  }
}

TEST(HostileMaps, ImpossibleSettingsAreRefused) {
  const auto same = [](GradientMap&) {};
  for (double Calibration::* number : {&Calibration::pixels_per_length_scale,
                                       &Calibration::blur,
                                       &Calibration::spectrum_smoothing,
                                       &Calibration::whitening_floor,
                                       &Calibration::clip,
                                       &Calibration::rotation_step,
                                       &Calibration::min_shared_area,
                                       &Calibration::min_separation,
                                       &Calibration::peak_threshold,
                                       &Calibration::wraparound,
                                       &Calibration::tail,
                                       &Calibration::independent_tests,
                                       &Calibration::max_correlation,
                                       &Calibration::ambiguity_ratio,
                                       &Calibration::equivalence_ratio,
                                       &Calibration::ambiguity_chance,
                                       &Calibration::block,
                                       &Calibration::noise_factor,
                                       &Calibration::warp_noise_factor,
                                       &Calibration::usual_warp,
                                       &Calibration::usual_warp_samples})
    for (const double bad : {kNan, kInf, 0.0, -1.0}) {
      MatchSettings settings;
      settings.calibration.*number = bad;
      expect(true, "calibration", same, settings);
    }
  for (const double bad : {kNan, kInf, 0.0, -1.0}) {
    expect(true, "pairs", same, {bad, 0.01, {}});
    expect(true, "max_false_loops", same, {1.0, bad, {}});
  }
  for (int Calibration::* number : {&Calibration::max_pixels, &Calibration::candidates})
    for (const int bad : {0, -1, std::numeric_limits<int>::min()}) {
      MatchSettings settings;
      settings.calibration.*number = bad;
      expect(true, "calibration", same, settings);
    }
}

TEST(HostileMaps, ExtremeSettingsHaveAnAnswer) {
  for (double Calibration::* number :
       {&Calibration::pixels_per_length_scale, &Calibration::blur, &Calibration::spectrum_smoothing,
        &Calibration::whitening_floor, &Calibration::clip, &Calibration::rotation_step,
        &Calibration::min_shared_area, &Calibration::min_separation, &Calibration::peak_threshold,
        &Calibration::tail, &Calibration::independent_tests, &Calibration::ambiguity_ratio,
        &Calibration::equivalence_ratio, &Calibration::ambiguity_chance, &Calibration::block,
        &Calibration::noise_factor, &Calibration::warp_noise_factor, &Calibration::usual_warp,
        &Calibration::usual_warp_samples})
    for (const double odd : {kTiny, 1e-6, 1e-3, 1e6, kHuge}) {
      MatchSettings settings;
      settings.calibration.*number = odd;
      try {
        EXPECT_FALSE(match(kMap.view(), kMap.view(), settings).reason.empty());
      } catch (const std::invalid_argument&) {
      }
    }
  for (const double odd : {kTiny, kHuge}) {
    EXPECT_FALSE(match(kMap.view(), kMap.view(), {odd, 0.01, {}}).reason.empty());
    EXPECT_FALSE(match(kMap.view(), kMap.view(), {1.0, odd, {}}).reason.empty());
  }
}

std::vector<double> cloud(int count) {
  std::vector<double> xyz;
  for (int i = 0; i < count; ++i)
    xyz.insert(xyz.end(), {0.1 * (i % 20), 0.1 * (i / 20), 0.05 * std::sin(0.3 * i)});
  return xyz;
}

TEST(HostileMaps, PointsThatMakeNoMapAreRefused) {
  const std::vector<double> good = cloud(400);
  const MapSettings usual{{0.4, 0.01}, 0.01};
  EXPECT_EQ(make_gradient_map(good.data(), 400, usual).cols, 29);
  EXPECT_THROW(make_gradient_map(nullptr, 0, usual), std::invalid_argument);
  EXPECT_THROW(make_gradient_map(good.data(), 99, usual), std::invalid_argument);
  for (const double bad : {kNan, kInf, kHuge, 1e9})
    for (const int column : {0, 1, 2}) {
      std::vector<double> points = good;
      points[300 + column] = bad;
      if (column == 2 && bad == 1e9) continue;  // a spike, which is no terrain
      EXPECT_THROW(make_gradient_map(points.data(), 400, usual), std::invalid_argument);
    }
  for (const double bad : {kNan, kInf, 0.0, -1.0}) {
    EXPECT_THROW(make_gradient_map(good.data(), 400, {{bad, 0.01}, 0.01}), std::invalid_argument);
    EXPECT_THROW(make_gradient_map(good.data(), 400, {{0.4, bad}, 0.01}), std::invalid_argument);
    EXPECT_THROW(make_gradient_map(good.data(), 400, {{0.4, 0.01}, bad}), std::invalid_argument);
    EXPECT_THROW(make_gradient_map(good.data(), 400, {{0.4, 0.01}, 0.01, 0.1, bad}), std::invalid_argument);
  }
  for (const double bad : {kNan, kInf, -1.0, kTiny, 1e-6})
    EXPECT_THROW(make_gradient_map(good.data(), 400, {{0.4, 0.01}, 0.01, bad}), std::invalid_argument);
  EXPECT_THROW(make_gradient_map(good.data(), 400, {{0.4, 0.01}, 0.01, 0.1, 0.25, 0}), std::invalid_argument);
}

TEST(HostileMaps, DegenerateCloudsHaveAnAnswer) {
  for (const double width : {0.0, kTiny, 1e-9, 1.0})
    for (const double height : {0.0, kTiny, 1.0, 1e9}) {
      std::vector<double> points = cloud(400);
      for (std::size_t i = 0; i < points.size(); ++i) points[i] *= i % 3 == 2 ? height : width;
      try {
        EXPECT_GT(make_gradient_map(points.data(), 400, {{0.4, 0.01}, 0.01}).rows, 0);
      } catch (const std::exception&) {
      }
    }
}

}  // namespace
}  // namespace terrainloop
