#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "terrainloop/surf.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace terrainloop {
namespace {

using AnyArray = nb::ndarray<nb::ro, nb::device::cpu>;

template <typename T>
ImageView<T> view(const AnyArray& array, const char* name, const char* dtype) {
  const std::string subject(name);
  if (array.ndim() != 2) throw nb::value_error((subject + " must be 2-D").c_str());
  if (array.dtype() != nb::dtype<T>()) throw nb::value_error((subject + " must be " + dtype).c_str());
  if (array.size() == 0) throw nb::value_error((subject + " must not be empty").c_str());
  const std::size_t rows = array.shape(0), cols = array.shape(1);
  const bool packed = (cols == 1 || array.stride(1) == 1) &&
                      (rows == 1 || array.stride(0) == static_cast<std::int64_t>(cols));
  if (!packed)
    throw nb::value_error((subject + " must be C-contiguous: use numpy.ascontiguousarray").c_str());
  return {static_cast<const T*>(array.data()), static_cast<int>(rows), static_cast<int>(cols)};
}

ImageView<float> image_view(const AnyArray& array) {
  const ImageView<float> image = view<float>(array, "image", "float32");
  if (!std::all_of(image.data, image.data + array.size(), [](float v) { return std::isfinite(v); }))
    throw nb::value_error("image must be finite");
  return image;
}

/// A NumPy array that takes over the vector's memory.
template <typename T>
auto to_numpy(std::vector<T> values, std::size_t rows, std::size_t cols) {
  auto owned = std::make_unique<std::vector<T>>(std::move(values));
  T* data = owned->data();
  nb::capsule owner(owned.release(), [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T, nb::ndim<2>>(data, {rows, cols}, owner);
}

nb::tuple surf_extract(const AnyArray& image, std::optional<AnyArray> mask, double threshold, int octaves,
                       int intervals, std::optional<std::size_t> max_keypoints) {
  const ImageView<float> pixels = image_view(image);
  ImageView<std::uint8_t> allowed;
  if (mask) {
    allowed = view<std::uint8_t>(*mask, "mask", "uint8");
    if (allowed.rows != pixels.rows || allowed.cols != pixels.cols)
      throw nb::value_error("mask must have the shape of image");
  }
  if (!(threshold >= 0.0)) throw nb::value_error("threshold must be >= 0");
  if (octaves < 1 || octaves > 16) throw nb::value_error("octaves must be within 1..16");
  if (intervals < 3 || intervals > 16) throw nb::value_error("intervals must be within 3..16");
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
  return nb::make_tuple(to_numpy(std::move(keypoints), count, 6),
                        to_numpy(std::move(descriptors), count, 64));
}

auto fast_hessian(const AnyArray& image, int filter_size) {
  const ImageView<float> pixels = image_view(image);
  if (filter_size < 9 || filter_size % 6 != 3) throw nb::value_error("filter_size must be 9, 15, 21, ...");
  std::vector<double> response;
  {
    nb::gil_scoped_release release;
    response = surf::fast_hessian(pixels, filter_size);
  }
  return to_numpy(std::move(response), pixels.rows, pixels.cols);
}

}  // namespace
}  // namespace terrainloop

NB_MODULE(_core, module) {
  module.def("surf", &terrainloop::surf_extract, "image"_a, "mask"_a = nb::none(), nb::kw_only(),
             "threshold"_a = 0.0, "octaves"_a = 4, "intervals"_a = 4, "max_keypoints"_a = nb::none());
  module.def("fast_hessian", &terrainloop::fast_hessian, "image"_a, "filter_size"_a);
}
