#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "terrainloop/image.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace terrainloop {

using Doubles = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Floats = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using AnyArray = nb::ndarray<nb::ro, nb::device::cpu>;

constexpr std::size_t kLargestInt = std::numeric_limits<int>::max();

template <typename T>
ImageView<T> view(const AnyArray& array, const char* name, const char* dtype) {
  const std::string subject(name);
  if (array.ndim() != 2) throw nb::value_error((subject + " must be 2-D").c_str());
  if (array.dtype() != nb::dtype<T>()) throw nb::value_error((subject + " must be " + dtype).c_str());
  if (array.size() == 0) throw nb::value_error((subject + " must not be empty").c_str());
  const std::size_t rows = array.shape(0), cols = array.shape(1);
  if (std::max(rows, cols) > kLargestInt) throw nb::value_error((subject + " is too large").c_str());
  const bool packed = (cols == 1 || array.stride(1) == 1) &&
                      (rows == 1 || array.stride(0) == static_cast<std::int64_t>(cols));
  if (!packed)
    throw nb::value_error((subject + " must be C-contiguous: use numpy.ascontiguousarray").c_str());
  return {static_cast<const T*>(array.data()), static_cast<int>(rows), static_cast<int>(cols)};
}

/// A NumPy array that takes over the vector's memory.
template <typename T>
auto to_numpy(std::vector<T> values, std::initializer_list<std::size_t> shape) {
  auto owned = std::make_unique<std::vector<T>>(std::move(values));
  T* data = owned->data();
  nb::capsule owner(owned.release(), [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T>(data, shape.size(), shape.begin(), owner);
}

/// Functions for matching, added to the module.
void bind_matching(nb::module_& module);

/// The one call of C++ users, and the making of maps, added to the module.
void bind_match(nb::module_& module);

}  // namespace terrainloop
