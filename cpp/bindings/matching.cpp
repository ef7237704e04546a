#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <optional>
#include <tuple>

#include "arrays.hpp"
#include "matching/search.hpp"
#include "terrainloop/field.hpp"
#include "terrainloop/inliers.hpp"
#include "terrainloop/refine.hpp"

namespace terrainloop {
namespace {

auto search_spectra(const Floats& images, int size) {
  if (size < 1) throw nb::value_error("size must be positive");
  if (images.ndim() != 4 || images.shape(0) > kLargestInt || images.shape(0) % search::kLanes != 0 ||
      images.shape(1) != 2 || images.shape(2) != images.shape(3) ||
      images.shape(2) > static_cast<std::size_t>(size))
    throw nb::value_error("images must be (K, 2, n, n), K a multiple of LANES, n no more than size");
  const std::size_t blocks = images.shape(0) / search::kLanes, side = size;
  std::vector<float> spectra;
  {
    nb::gil_scoped_release release;
    spectra = search::conjugate_spectra(images.data(), static_cast<int>(blocks),
                                        static_cast<int>(images.shape(2)), size);
  }
  return to_numpy(std::move(spectra), {blocks, 2, side, side / 2 + 1, 2, search::kLanes});
}

nb::tuple search_correlate(const Floats& fields, const Floats& ground, const Floats& stored_field,
                           const Floats& stored_ground, double least_shared, double evident) {
  const auto has_shape = [](const Floats& array, const std::vector<std::size_t>& shape) {
    return array.ndim() == shape.size() && std::equal(shape.begin(), shape.end(), array.shape_ptr());
  };
  if (fields.ndim() != 6 || std::max(fields.shape(0), fields.shape(2)) > kLargestInt)
    throw nb::value_error("fields must be (blocks, 2, size, waves, 2, LANES)");
  const std::size_t blocks = fields.shape(0), size = fields.shape(2), half = size / 2;
  const std::size_t lanes = search::kLanes;
  if (!has_shape(fields, {blocks, 2, size, size / 2 + 1, 2, lanes}) ||
      !has_shape(ground, {blocks, 2, half, half / 2 + 1, 2, lanes}) ||
      !has_shape(stored_field, {2, size, size / 2 + 1, 2}) ||
      !has_shape(stored_ground, {2, half, half / 2 + 1, 2}))
    throw nb::value_error("fields must be of one size, grounds of half of it");
  search::Correlations found;
  {
    nb::gil_scoped_release release;
    const search::TurnedSpectra source{fields.data(), ground.data(), static_cast<int>(blocks)};
    const search::StoredSpectra stored{stored_field.data(), stored_ground.data()};
    found = search::correlate(source, stored, static_cast<int>(size), least_shared, evident);
  }
  std::vector<double> poses;
  for (const search::Pose& p : found.evident)
    poses.insert(poses.end(), {static_cast<double>(p.rotation), static_cast<double>(p.row),
                               static_cast<double>(p.column), p.squared_correlation, p.samples});
  const std::size_t count = found.evident.size(), rotations = found.sample.size();
  return nb::make_tuple(to_numpy(std::move(poses), {count, 5}),
                        to_numpy(std::move(found.sample), {rotations}),
                        to_numpy(std::move(found.admissible), {rotations}));
}

Lookup affine(const Doubles& matrix) {
  if (matrix.ndim() != 2 || matrix.shape(0) != 3 || matrix.shape(1) != 3)
    throw nb::value_error("affine must be (3, 3)");
  Lookup rows;
  std::copy(matrix.data(), matrix.data() + 6, rows.begin());
  return rows;
}

auto turn(const AnyArray& x, const AnyArray& y, const AnyArray& known, const Doubles& lookup, int rows,
          int cols) {
  const ImageView<float> images[] = {view<float>(x, "x", "float32"), view<float>(y, "y", "float32"),
                                     view<float>(known, "known", "float32")};
  if (rows < 0 || cols < 0) throw nb::value_error("rows and cols must not be negative");
  const Lookup to = affine(lookup);
  const std::size_t height = rows, width = cols;
  std::vector<float> turned(3 * height * width);
  // Too short to be worth releasing Python's lock, which another thread would hold for longer.
  turn_field(images[0], images[1], images[2], to, rows, cols, turned.data());
  return to_numpy(std::move(turned), {3, height, width});
}

auto inlier_counts(const Doubles& source, const Doubles& target, const Doubles& motions, double radius) {
  if (source.ndim() != 2 || source.shape(1) != 2 || target.ndim() != 2 || target.shape(1) != 2 ||
      source.shape(0) != target.shape(0) || motions.ndim() != 2 || motions.shape(1) != 4)
    throw nb::value_error("source and target must be (A, 2), motions (K, 4)");
  std::vector<int> counts(motions.shape(0));
  count_inliers(source.data(), target.data(), source.shape(0), motions.data(), motions.shape(0), radius,
                counts.data());
  const std::size_t count = counts.size();
  return to_numpy(std::move(counts), {count});
}

/// x, y, variance, mask, (x, y) of the origin, resolution.
using GradientArrays = std::tuple<AnyArray, AnyArray, AnyArray, AnyArray, std::tuple<double, double>, double>;

refine::Gradients gradients(const GradientArrays& map) {
  const auto& [x, y, variance, mask, origin, resolution] = map;
  const refine::Gradients seen{view<float>(x, "gradient_x", "float32"),
                               view<float>(y, "gradient_y", "float32"),
                               view<float>(variance, "gradient_variance", "float32"),
                               view<std::uint8_t>(mask, "mask", "uint8"),
                               std::get<0>(origin),
                               std::get<1>(origin),
                               resolution};
  return seen;
}

nb::object settle(const GradientArrays& source, const GradientArrays& target, const Doubles& motion, int step,
                  int places, int steps, double tolerance) {
  const refine::Gradients from = gradients(source), to = gradients(target);
  const Lookup rows = affine(motion);
  std::optional<refine::Linearised> found;
  {
    nb::gil_scoped_release release;
    found = refine::settle(from, to, {rows[0], rows[3], rows[2], rows[5]}, {step, places, steps, tolerance});
  }
  if (!found) return nb::none();
  const auto [c, s, x, y] = found->motion;
  const std::size_t count = found->ground.size() / 2;
  return nb::make_tuple(
      to_numpy<double>({c, -s, x, s, c, y, 0, 0, 1}, {3, 3}),
      to_numpy<double>({found->pivot_x, found->pivot_y}, {2}), to_numpy(std::move(found->ground), {count, 2}),
      to_numpy(std::move(found->residual), {2, count}), to_numpy(std::move(found->weights), {2, count}),
      to_numpy(std::move(found->slopes), {2, count}), to_numpy(std::move(found->by_motion), {2, count, 5}));
}

}  // namespace

void bind_matching(nb::module_& module) {
  module.attr("LANES") = search::kLanes;
  module.def("search_spectra", &search_spectra, "images"_a, "size"_a);
  module.def("search_correlate", &search_correlate, "fields"_a, "ground"_a, "stored_field"_a,
             "stored_ground"_a, nb::kw_only(), "least_shared"_a, "evident"_a);
  module.def("turn_field", &turn, "x"_a, "y"_a, "known"_a, "affine"_a, nb::kw_only(), "rows"_a, "cols"_a);
  module.def("inlier_counts", &inlier_counts, "source"_a, "target"_a, "motions"_a, "radius"_a);
  module.def("settle", &settle, "source"_a, "target"_a, "T_target_source"_a, nb::kw_only(), "step"_a,
             "places"_a, "steps"_a, "tolerance"_a);
}

}  // namespace terrainloop
