#include "terrainloop/match.hpp"

#include <nanobind/stl/array.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "terrainloop/gradient_map.hpp"

namespace terrainloop {
namespace {

/// Calls visit(name, member) for each number of a calibration.
template <typename Visit>
void visit_numbers(Calibration& c, const Visit& visit) {
  visit("pixels_per_length_scale", c.pixels_per_length_scale);
  visit("max_pixels", c.max_pixels);
  visit("blur", c.blur);
  visit("spectrum_smoothing", c.spectrum_smoothing);
  visit("whitening_floor", c.whitening_floor);
  visit("clip", c.clip);
  visit("rotation_step", c.rotation_step);
  visit("min_shared_area", c.min_shared_area);
  visit("min_separation", c.min_separation);
  visit("peak_threshold", c.peak_threshold);
  visit("wraparound", c.wraparound);
  visit("candidates", c.candidates);
  visit("dense_hypotheses", c.dense_hypotheses);
  visit("tail", c.tail);
  visit("independent_tests", c.independent_tests);
  visit("max_correlation", c.max_correlation);
  visit("min_correlation", c.min_correlation);
  visit("min_participation", c.min_participation);
  visit("ambiguity_ratio", c.ambiguity_ratio);
  visit("equivalence_ratio", c.equivalence_ratio);
  visit("ambiguity_chance", c.ambiguity_chance);
  visit("block", c.block);
  visit("noise_factor", c.noise_factor);
  visit("warp_noise_factor", c.warp_noise_factor);
  visit("usual_warp", c.usual_warp);
  visit("usual_warp_samples", c.usual_warp_samples);
  visit("reach_of_radius", c.reach_of_radius);
  visit("motion_by_warp", c.motion_by_warp);
  visit("rotation_by_warp", c.rotation_by_warp);
}

nb::dict calibration() {
  Calibration defaults;
  nb::dict numbers;
  visit_numbers(defaults, [&](const char* name, const auto& value) { numbers[name] = nb::cast(value); });
  return numbers;
}

Calibration calibration_of(const nb::dict& given) {
  Calibration result;
  std::size_t known = 0;
  visit_numbers(result, [&](const char* name, auto& value) {
    if (!given.contains(name)) return;
    value = nb::cast<std::decay_t<decltype(value)>>(given[name]);
    ++known;
  });
  if (known != given.size()) throw nb::value_error("calibration has an unknown name");
  return result;
}

/// Elevation, gradient x, gradient y, gradient variance, mask, (x, y) of the origin, resolution, length
/// scale.
using MapArrays =
    std::tuple<AnyArray, AnyArray, AnyArray, AnyArray, AnyArray, std::tuple<double, double>, double, double>;

GradientMapView map_view(const MapArrays& map) {
  const auto& [elevation, x, y, variance, mask, origin, resolution, length_scale] = map;
  return {view<float>(elevation, "elevation", "float32"),
          view<float>(x, "gradient_x", "float32"),
          view<float>(y, "gradient_y", "float32"),
          view<float>(variance, "gradient_variance", "float32"),
          view<std::uint8_t>(mask, "mask", "uint8"),
          std::get<0>(origin),
          std::get<1>(origin),
          resolution,
          length_scale};
}

template <std::size_t N>
auto to_array(const std::array<double, N>& values, std::initializer_list<std::size_t> shape) {
  return to_numpy(std::vector<double>(values.begin(), values.end()), shape);
}

nb::dict match_maps(const MapArrays& source, const MapArrays& target, double pairs, double max_false_loops,
                    const nb::dict& changed) {
  const GradientMapView from = map_view(source), to = map_view(target);
  const MatchSettings settings{pairs, max_false_loops, calibration_of(changed)};
  Match found;
  {
    nb::gil_scoped_release release;
    found = match(from, to, settings);
  }
  nb::dict result;
  result["accepted"] = found.accepted;
  result["reason"] = found.reason;
  result["T_target_source"] = to_array(found.T_target_source, {4, 4});
  result["covariance"] = to_array(found.covariance, {6, 6});
  result["source_origin"] = to_array(found.source_origin, {3});
  result["target_origin"] = to_array(found.target_origin, {3});
  result["correlation"] = found.correlation;
  result["area"] = found.area;
  result["score"] = found.score;
  result["log_nfa"] = found.log_nfa;
  result["overlap"] = found.overlap;
  return result;
}

nb::dict gradient_map(const Doubles& xyz, double length_scale, double variance, double noise,
                      double resolution, double max_variance_ratio, int threads) {
  if (xyz.ndim() != 2 || xyz.shape(1) != 3) throw nb::value_error("xyz must be (N, 3)");
  GradientMap map;
  {
    nb::gil_scoped_release release;
    map = make_gradient_map(xyz.data(), xyz.shape(0),
                            {{length_scale, variance}, noise, resolution, max_variance_ratio, threads});
  }
  const std::initializer_list<std::size_t> shape = {static_cast<std::size_t>(map.rows),
                                                    static_cast<std::size_t>(map.cols)};
  nb::dict result;
  result["elevation"] = to_numpy(std::move(map.elevation), shape);
  result["gradient_x"] = to_numpy(std::move(map.gradient_x), shape);
  result["gradient_y"] = to_numpy(std::move(map.gradient_y), shape);
  result["variance"] = to_numpy(std::move(map.variance), shape);
  result["gradient_variance"] = to_numpy(std::move(map.gradient_variance), shape);
  result["mask"] = to_numpy(std::move(map.mask), shape);
  result["origin"] = nb::make_tuple(map.origin_x, map.origin_y);
  result["resolution"] = map.resolution;
  return result;
}

}  // namespace

void bind_match(nb::module_& module) {
  module.def("calibration", &calibration);
  module.def("match", &match_maps, "source"_a, "target"_a, nb::kw_only(), "pairs"_a = 1.0,
             "max_false_loops"_a = 0.01, "calibration"_a = nb::dict());
  module.def("make_gradient_map", &gradient_map, "xyz"_a, nb::kw_only(), "length_scale"_a, "variance"_a,
             "noise"_a, "resolution"_a = 0.0, "max_variance_ratio"_a = 0.25, "threads"_a = 1);
}

}  // namespace terrainloop
