#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "level.hpp"
#include "terrainloop/gp.hpp"
#include "terrainloop/likelihood.hpp"
#include "terrainloop/surf.hpp"

namespace terrainloop {
namespace {

nb::tuple surf_extract(const AnyArray& image, std::optional<AnyArray> mask, double threshold, int octaves,
                       int intervals, std::optional<std::size_t> max_keypoints) {
  const auto pixels = view<float>(image, "image", "float32");
  ImageView<std::uint8_t> allowed;
  if (mask) allowed = view<std::uint8_t>(*mask, "mask", "uint8");
  surf::Settings settings{threshold, octaves, intervals};
  if (max_keypoints) settings.max_keypoints = *max_keypoints;

  std::vector<double> keypoints;
  std::vector<float> descriptors;
  {
    nb::gil_scoped_release release;
    const surf::Features found = surf::extract(pixels, allowed, settings);
    for (const auto& k : found.keypoints)
      keypoints.insert(keypoints.end(),
                       {k.x, k.y, k.scale, k.orientation, k.response, static_cast<double>(k.laplacian)});
    for (const auto& d : found.descriptors) descriptors.insert(descriptors.end(), d.begin(), d.end());
  }
  const std::size_t count = keypoints.size() / 6;
  return nb::make_tuple(to_numpy(std::move(keypoints), {count, 6}),
                        to_numpy(std::move(descriptors), {count, 64}));
}

auto fast_hessian(const AnyArray& image, int filter_size) {
  const auto pixels = view<float>(image, "image", "float32");
  std::vector<double> response;
  {
    nb::gil_scoped_release release;
    response = surf::fast_hessian(pixels, filter_size);
  }
  return to_numpy(std::move(response),
                  {static_cast<std::size_t>(pixels.rows), static_cast<std::size_t>(pixels.cols)});
}

gp::Points points_view(const Doubles& xy, const Doubles& elevation, const Doubles& noise) {
  if (xy.ndim() != 2 || xy.shape(1) != 2) throw nb::value_error("xy must be (N, 2)");
  for (const Doubles* column : {&elevation, &noise})
    if (column->ndim() != 1 || column->shape(0) != xy.shape(0))
      throw nb::value_error("elevation and noise must have one number a point");
  return {xy.data(), elevation.data(), noise.data(), xy.shape(0)};
}

/// Arrays for the five maps and their views, filled by predict(maps) without the GIL.
template <typename Shape, typename Predict>
nb::list five_maps(std::size_t count, const Shape& shape, const Predict& predict) {
  std::vector<std::unique_ptr<float[]>> images;
  for (int i = 0; i < 5; ++i) images.emplace_back(new float[count]);
  {
    nb::gil_scoped_release release;
    predict(gp::Maps{images[0].get(), images[1].get(), images[2].get(), images[3].get(), images[4].get()});
  }
  nb::list maps;
  for (std::unique_ptr<float[]>& image : images) {
    float* data = image.release();
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<float*>(p); });
    maps.append(nb::ndarray<nb::numpy, float>(data, shape.size(), shape.begin(), owner));
  }
  return maps;
}

nb::list gp_predict_grid(const Doubles& xy, const Doubles& elevation, const Doubles& noise,
                         double length_scale, double variance, double x, double y, double resolution,
                         int rows, int cols, int threads) {
  const gp::Points points = points_view(xy, elevation, noise);
  if (rows < 0 || cols < 0) throw nb::value_error("rows and cols must not be negative");
  const std::initializer_list<std::size_t> shape = {static_cast<std::size_t>(rows),
                                                    static_cast<std::size_t>(cols)};
  return five_maps(static_cast<std::size_t>(rows) * cols, shape, [&](const gp::Maps& maps) {
    gp::predict_grid(points, {length_scale, variance}, {x, y, resolution, rows, cols}, maps, threads);
  });
}

nb::list gp_predict_at(const Doubles& xy, const Doubles& elevation, const Doubles& noise, double length_scale,
                       double variance, const Doubles& queries, int threads) {
  const gp::Points points = points_view(xy, elevation, noise);
  if (queries.ndim() != 2 || queries.shape(1) != 2) throw nb::value_error("queries must be (Q, 2)");
  const std::initializer_list<std::size_t> shape = {queries.shape(0)};
  return five_maps(queries.shape(0), shape, [&](const gp::Maps& maps) {
    gp::predict_at(points, {length_scale, variance}, queries.data(), queries.shape(0), maps, threads);
  });
}

auto gp_noise_ratio(const Doubles& xy, const Doubles& elevation, double cell, double smallest_scatter,
                    int threads) {
  const gp::Points points = points_view(xy, elevation, elevation);
  std::vector<double> ratio(points.count);
  {
    nb::gil_scoped_release release;
    gp::noise_ratio(points.xy, points.elevation, points.count, cell, smallest_scatter, ratio.data(), threads);
  }
  return to_numpy(std::move(ratio), {points.count, 1});
}

nb::tuple gp_block_likelihood(const std::vector<std::tuple<Doubles, Doubles, Doubles>>& surfaces,
                              double length_scale, double variance, double noise, double side, double work,
                              int threads) {
  std::vector<gp::Points> points;
  for (const auto& [xy, elevation, relative_noise] : surfaces)
    points.push_back(points_view(xy, elevation, relative_noise));
  std::shared_ptr<const gp::BlockLikelihood> likelihood;
  {
    nb::gil_scoped_release release;
    const gp::Hyperparameters about{length_scale, variance};
    likelihood = std::make_shared<gp::BlockLikelihood>(points, about, noise, side, work, threads);
  }
  const auto evaluate = [likelihood](double length_scale, double variance, double noise) {
    nb::gil_scoped_release release;
    const std::array<double, 4> terms = (*likelihood)({length_scale, variance}, noise);
    return std::make_tuple(terms[0], std::make_tuple(terms[1], terms[2], terms[3]));
  };
  return nb::make_tuple(nb::cpp_function(evaluate), likelihood->blocks(), likelihood->rank(),
                        likelihood->points());
}

}  // namespace
}  // namespace terrainloop

NB_MODULE(TERRAINLOOP_MODULE, module) {
  module.attr("VARIANT") = TERRAINLOOP_VARIANT;
  module.attr("LEVEL") = terrainloop::instruction_level();
  module.def("surf", &terrainloop::surf_extract, "image"_a, "mask"_a = nb::none(), nb::kw_only(),
             "threshold"_a = 0.0, "octaves"_a = 4, "intervals"_a = 4, "max_keypoints"_a = nb::none());
  module.def("gp_predict_grid", &terrainloop::gp_predict_grid, "xy"_a, "elevation"_a, "noise"_a,
             nb::kw_only(), "length_scale"_a, "variance"_a, "x"_a, "y"_a, "resolution"_a, "rows"_a, "cols"_a,
             "threads"_a = 1);
  module.def("gp_predict_at", &terrainloop::gp_predict_at, "xy"_a, "elevation"_a, "noise"_a, nb::kw_only(),
             "length_scale"_a, "variance"_a, "queries"_a, "threads"_a = 1);
  module.def("gp_noise_ratio", &terrainloop::gp_noise_ratio, "xy"_a, "elevation"_a, nb::kw_only(), "cell"_a,
             "smallest_scatter"_a = 0.0, "threads"_a = 1);
  module.def("gp_block_likelihood", &terrainloop::gp_block_likelihood, "surfaces"_a, nb::kw_only(),
             "length_scale"_a, "variance"_a, "noise"_a, "side"_a, "work"_a, "threads"_a = 1);
  module.def("fast_hessian", &terrainloop::fast_hessian, "image"_a, "filter_size"_a);
  terrainloop::bind_matching(module);
  terrainloop::bind_match(module);
}
