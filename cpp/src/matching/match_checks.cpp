#include "match_checks.hpp"

#include <cmath>
#include <initializer_list>
#include <stdexcept>
#include <string>

#include "../image_checks.hpp"

namespace terrainloop::matching {
namespace {

// As terrainloop.gradient_map in Python.
constexpr double kLargest = 1e12;          // of any number of a map: its square is far from the end of float
constexpr double kMostPixels = 20e6;       // of a map
constexpr double kMostLengthScales = 1e6;  // squares of one that a map covers
constexpr double kFinest = 1e4;            // pixels of a length scale

void require(bool met, const std::string& what) {
  if (!met) throw std::invalid_argument(what);
}

bool within(double value) { return std::abs(value) <= kLargest; }  // false for NaN too

bool positive(std::initializer_list<double> values) {
  for (const double value : values)
    if (!(value > 0.0 && std::isfinite(value))) return false;
  return true;
}

/// Within the range where a calibrated constant makes sense at all, and its arithmetic is that of numbers.
bool sensible(std::initializer_list<double> values, double lowest) {
  for (const double value : values)
    if (!(value >= lowest && value <= 1e6)) return false;
  return true;
}

bool finite(const ImageView<float>& image) {
  const std::size_t pixels = static_cast<std::size_t>(image.rows) * image.cols;
  for (std::size_t i = 0; i < pixels; ++i)
    if (!within(image.data[i])) return false;
  return true;
}

bool sound_mask(const GradientMapView& map) {
  const std::size_t pixels = static_cast<std::size_t>(map.mask.rows) * map.mask.cols;
  for (std::size_t i = 0; i < pixels; ++i) {
    if (map.mask.data[i] > 1) return false;
    if (map.mask.data[i] == 1 && !(map.gradient_variance.data[i] > 0.0f)) return false;
  }
  return true;
}

}  // namespace

void check_map(const GradientMapView& map, const char* name) {
  const std::string who = std::string("the ") + name + " map must have ";
  check(map.mask, "mask");
  const double pixels = static_cast<double>(map.mask.rows) * map.mask.cols;
  require(pixels > 0.0 && pixels <= kMostPixels, who + "1 to 20 million pixels");
  for (const ImageView<float>& image :
       {map.elevation, map.gradient_x, map.gradient_y, map.gradient_variance}) {
    require(image.data && same_shape(image, map.mask), who + "images of one shape");
    require(finite(image), who + "finite numbers below 1e12, also outside the mask");
  }
  require(sound_mask(map), who + "a mask of 0 and 1, and a positive gradient variance where it is 1");
  require(within(map.origin_x) && within(map.origin_y), who + "a finite origin");
  require(positive({map.resolution, map.length_scale}) && within(map.resolution) && within(map.length_scale),
          who + "a positive resolution and length scale");
  const double fine = map.length_scale / map.resolution;
  require(pixels <= kMostLengthScales * fine * fine, who + "at most 1e6 squares of the length scale");
  require(fine <= kFinest, who + "at most 1e4 pixels within a length scale");
}

void check_settings(const MatchSettings& settings) {
  const Calibration& c = settings.calibration;
  require(positive({settings.pairs, settings.max_false_loops}), "pairs and max_false_loops must be positive");
  require(
      sensible({c.pixels_per_length_scale, c.blur, c.spectrum_smoothing, c.whitening_floor, c.clip,
                c.rotation_step, c.min_shared_area, c.min_separation, c.peak_threshold, c.wraparound, c.tail,
                c.independent_tests, c.max_correlation, c.ambiguity_ratio, c.equivalence_ratio,
                c.ambiguity_chance},
               1e-6) &&
          sensible({c.block, c.noise_factor, c.warp_noise_factor, c.usual_warp, c.usual_warp_samples}, 1e-6),
      "the numbers of the calibration must be within 1e-6 and 1e6");
  require(sensible({c.min_correlation, c.min_participation, c.reach_of_radius, c.motion_by_warp[0],
                    c.motion_by_warp[1], c.motion_by_warp[2], c.rotation_by_warp[0], c.rotation_by_warp[1],
                    c.rotation_by_warp[2]},
                   0.0),
          "min_correlation, min_participation, reaches and warps must be within 0 and 1e6");
  require(
      c.wraparound <= 1.0 && c.max_correlation < 1.0 && c.min_correlation < 1.0 && c.min_participation < 1.0,
      "wraparound must be at most 1, correlations below 1");
  require(c.max_pixels >= 8 && c.candidates >= 1 && c.dense_hypotheses >= 0,
          "max_pixels must be at least 8, candidates 1, dense_hypotheses 0");
}

}  // namespace terrainloop::matching
