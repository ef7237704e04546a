#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>
#include <stdexcept>
#include <string>
#include <tuple>

#include "cells.hpp"
#include "checks.hpp"
#include "evaluate.hpp"
#include "solve.hpp"
#include "terrainloop/gp.hpp"

namespace terrainloop::gp {
namespace {

constexpr int kReach = 14;  // cells (7 length scales) from the nearest point to where only the prior is left
constexpr int kWindow = 320;        // cells along an axis that are solved at once, which bounds memory ...
constexpr int kHalo = 24;           // ... and cells around them, so that the solutions agree at the seams
constexpr int kMargins[] = {4, 7};  // knots by which subdomains overlap, and where that does not converge
constexpr double kMostArea = 1e8;  // cells, which are visited window by window even where there are no points
constexpr double kRounding = 1e-12;  // smallest variance, as a share of the prior's

struct Box {
  double low = std::numeric_limits<double>::infinity(), high = -low;
  void add(double value) {
    low = std::min(low, value);
    high = std::max(high, value);
  }
};

void check(const Points& points, const Hyperparameters& parameters, int threads) {
  const double length_scale = parameters.length_scale, variance = parameters.variance;
  if (!positive(length_scale) || !positive(variance))
    throw std::invalid_argument("length_scale and variance must be positive");
  if (!positive(length_scale * length_scale) || !positive(variance / (length_scale * length_scale)))
    throw std::invalid_argument("the variance of the slope must be a positive number");
  check_threads(threads);
  check_points(points);
}

/// Cells over the queried ground, as far as the points reach.
Lattice cover(const Points& points, const Box queries[2], double spacing) {
  Box ground[2];
  for (std::size_t i = 0; i < points.count; ++i)
    for (int axis : {0, 1}) ground[axis].add(points.xy[2 * i + axis]);
  int cells[2];
  double origin[2];
  for (int axis : {0, 1}) {
    const double reach = kReach * spacing;
    origin[axis] = std::min(ground[axis].low, std::max(queries[axis].low, ground[axis].low - reach));
    const double end = std::max(ground[axis].high, std::min(queries[axis].high, ground[axis].high + reach));
    const double count = std::max(1.0, std::ceil((end - origin[axis]) / spacing));
    if (!(count <= kMostCells))
      throw std::invalid_argument("the extent must be below half a million length scales");
    cells[axis] = static_cast<int>(count);
    origin[axis] -= 0.5 * (count * spacing - (end - origin[axis]));
  }
  if (static_cast<double>(cells[0]) * cells[1] > kMostArea)
    throw std::invalid_argument("the area must be below 25 million squares of a length scale");
  return {origin[0], origin[1], spacing, cells[1], cells[0]};
}

/// The cells [first, last) that a window predicts, and [low, high) that it solves.
struct Window {
  int first, last, low, high;
};

std::vector<Window> windows(int cells) {
  const int count = cells <= kWindow + 2 * kHalo ? 1 : (cells + kWindow - 1) / kWindow;
  std::vector<Window> result;
  for (int i = 0; i < count; ++i) {
    const int first = static_cast<int>(static_cast<long>(i) * cells / count);
    const int last = static_cast<int>(static_cast<long>(i + 1) * cells / count);
    result.push_back({first, last, std::max(0, first - kHalo), std::min(cells, last + kHalo)});
  }
  return result;
}

struct CellRange {
  int first_row, last_row, first_col, last_col;  ///< half-open
};
using Visit = std::function<void(Span rows, Span cols)>;
/// Calls the visitor with the queries on the cells, as rows x cols.
using Places = std::function<void(const CellRange&, const Visit&)>;

/// Posterior of one window of a lattice.
class WindowSolver {
 public:
  WindowSolver(const BinnedPoints& binned, const Lattice& lattice, double variance, ThreadPool& workers)
      : lattice_(lattice),
        covariance_(weight_covariance(std::max(lattice.knot_rows(), lattice.knot_cols()))),
        precision_{inverse(toeplitz(covariance_, lattice.knot_rows())),
                   inverse(toeplitz(covariance_, lattice.knot_cols())), variance},
        information_(binned, lattice, workers),
        workers_(workers) {}

  void predict(const Places& places, const Maps& maps, int stride) {
    std::string reason;
    for (const int margin : kMargins) try {
        return predict(places, maps, stride, margin);
      } catch (const std::runtime_error& error) {
        reason = error.what();
      }
    throw std::runtime_error(reason);
  }

 private:
  void predict(const Places& places, const Maps& maps, int stride, int margin) {
    const std::vector<Interval> rows = cut(lattice_.rows, margin, covariance_, precision_.rows);
    const std::vector<Interval> cols = cut(lattice_.cols, margin, covariance_, precision_.cols);
    std::vector<Subdomain> subdomains;
    for (const Interval& row : rows)
      for (const Interval& col : cols) subdomains.emplace_back(row, col);
    const auto each = [&](const std::function<void(Subdomain&, const CellRange&)>& body) {
      workers_.run(static_cast<int>(subdomains.size()), [&](int i) {
        const Interval &row = subdomains[i].rows(), &col = subdomains[i].cols();
        body(subdomains[i], {row.first_cell, row.last_cell, col.first_cell, col.last_cell});
      });
    };
    each([&](Subdomain& subdomain, const CellRange& cells) {
      bool wanted = false;
      if (maps.variance || maps.gradient_variance) places(cells, [&](Span, Span) { wanted = true; });
      Eigen::MatrixXf covariance;
      subdomain.factorise(information_, precision_.variance, wanted ? &covariance : nullptr);
      if (!wanted) return;
      const VarianceField field(covariance, subdomain, lattice_.spacing, kRounding * precision_.variance);
      places(cells, [&](Span r, Span c) { field.evaluate(r, c, maps, stride); });
    });
    if (!maps.elevation && !maps.gradient_x && !maps.gradient_y) return;
    const RowMatrix weights = solve_weights(information_, precision_, subdomains, workers_);
    each([&](Subdomain&, const CellRange& cells) {
      places(cells, [&](Span r, Span c) { evaluate_mean(weights, lattice_.spacing, r, c, maps, stride); });
    });
  }

  const Lattice& lattice_;
  std::vector<double> covariance_;
  Precision precision_;
  Information information_;
  ThreadPool& workers_;
};

/// Solves window after window; `places_of` gives the queries in one, `count` is the number of all queries.
void predict(const Points& points, const Hyperparameters& parameters, const Box queries[2], std::size_t count,
             const std::function<Places(const Lattice&, const Window&, const Window&)>& places_of,
             const Maps& maps, int stride, int threads) {
  const double prior_slope = parameters.variance / (parameters.length_scale * parameters.length_scale);
  const auto fill = [count](float* map, double value) {
    if (map) std::fill(map, map + count, static_cast<float>(value));
  };
  for (float* map : {maps.elevation, maps.gradient_x, maps.gradient_y}) fill(map, 0.0);
  fill(maps.variance, parameters.variance);
  fill(maps.gradient_variance, prior_slope);
  const double spacing = kKnotSpacing * parameters.length_scale;
  const Lattice whole = cover(points, queries, spacing);
  ThreadPool workers(threads);
  for (const Window& row : windows(whole.rows))
    for (const Window& col : windows(whole.cols)) {
      const Lattice lattice{whole.x + col.low * spacing, whole.y + row.low * spacing, spacing,
                            row.high - row.low, col.high - col.low};
      const BinnedPoints binned = bin(points, lattice);
      if (!binned.points.empty())
        WindowSolver(binned, lattice, parameters.variance, workers)
            .predict(places_of(whole, row, col), maps, stride);
    }
}

/// The samples at origin + step * index on the cells of a window, relative to it.
std::vector<Sample> axis_samples(double origin, double step, int count, double corner, double spacing,
                                 const Window& window, int cells) {
  std::vector<Sample> samples;
  for (int index = 0; index < count; ++index) {
    const double at = (origin + step * index - corner) / spacing;
    if (at < -kRounding || at > cells + kRounding) continue;
    const int cell = std::min(static_cast<int>(at), cells - 1);
    if (cell < window.first || cell >= window.last) continue;
    samples.push_back(sample_at(cell - window.low, at - cell, index));
  }
  return samples;
}

Span on_cells(const std::vector<Sample>& sorted, int first, int last) {
  const auto before = [](const Sample& sample, int cell) { return sample.cell < cell; };
  const auto begin = std::lower_bound(sorted.begin(), sorted.end(), first, before);
  const auto end = std::lower_bound(begin, sorted.end(), last, before);
  return {sorted.data() + (begin - sorted.begin()), sorted.data() + (end - sorted.begin())};
}

/// A single query, by the cell of the window that contains it.
struct Place {
  int row, col;
  double v, u;
  int index;
};

}  // namespace

void predict_grid(const Points& points, const Hyperparameters& parameters, const Grid& grid, const Maps& maps,
                  int threads) {
  check(points, parameters, threads);
  if (!std::isfinite(grid.x + grid.y + grid.resolution) || !(grid.resolution > 0.0) || grid.rows < 0 ||
      grid.cols < 0)
    throw std::invalid_argument(
        "the grid must have a finite origin, a positive resolution and no negative size");
  if (grid.rows == 0 || grid.cols == 0) return;
  const Box queries[2] = {{grid.x, grid.x + grid.resolution * (grid.cols - 1)},
                          {grid.y, grid.y + grid.resolution * (grid.rows - 1)}};
  const auto places_of = [&grid](const Lattice& whole, const Window& row, const Window& col) -> Places {
    return [rows = axis_samples(grid.y, grid.resolution, grid.rows, whole.y, whole.spacing, row, whole.rows),
            cols = axis_samples(grid.x, grid.resolution, grid.cols, whole.x, whole.spacing, col, whole.cols)](
               const CellRange& cells, const Visit& visit) {
      const Span on_rows = on_cells(rows, cells.first_row, cells.last_row);
      const Span on_cols = on_cells(cols, cells.first_col, cells.last_col);
      if (on_rows.begin() != on_rows.end() && on_cols.begin() != on_cols.end()) visit(on_rows, on_cols);
    };
  };
  predict(points, parameters, queries, static_cast<std::size_t>(grid.rows) * grid.cols, places_of, maps,
          grid.cols, threads);
}

void predict_at(const Points& points, const Hyperparameters& parameters, const double* queries,
                std::size_t count, const Maps& maps, int threads) {
  check(points, parameters, threads);
  if (count > static_cast<std::size_t>(std::numeric_limits<int>::max()))
    throw std::invalid_argument("there must be fewer than 2^31 queries");
  if (count == 0) return;
  Box box[2];
  for (std::size_t i = 0; i < 2 * count; ++i) {
    if (!std::isfinite(queries[i])) throw std::invalid_argument("queries must be finite");
    box[i % 2].add(queries[i]);
  }
  const auto places_of = [=](const Lattice& whole, const Window& row, const Window& col) -> Places {
    std::vector<Place> places;
    for (std::size_t i = 0; i < count; ++i) {
      const double u = (queries[2 * i] - whole.x) / whole.spacing,
                   v = (queries[2 * i + 1] - whole.y) / whole.spacing;
      if (u < 0.0 || v < 0.0 || u > whole.cols || v > whole.rows) continue;
      const int r = std::min(static_cast<int>(v), whole.rows - 1),
                c = std::min(static_cast<int>(u), whole.cols - 1);
      if (r >= row.first && r < row.last && c >= col.first && c < col.last)
        places.push_back({r - row.low, c - col.low, v - r, u - c, static_cast<int>(i)});
    }
    const auto before = [](const Place& a, const Place& b) {
      return std::tie(a.row, a.col, a.index) < std::tie(b.row, b.col, b.index);
    };
    std::sort(places.begin(), places.end(), before);
    return [places = std::move(places), before](const CellRange& cells, const Visit& visit) {
      for (int r = cells.first_row; r < cells.last_row; ++r)
        for (auto place =
                 std::lower_bound(places.begin(), places.end(), Place{r, cells.first_col, 0, 0, 0}, before);
             place != places.end() && place->row == r && place->col < cells.last_col; ++place) {
          const Sample on_row = sample_at(r, place->v, 0),
                       on_col = sample_at(place->col, place->u, place->index);
          visit({&on_row, &on_row + 1}, {&on_col, &on_col + 1});
        }
    };
  };
  predict(points, parameters, box, count, places_of, maps, 0, threads);
}

}  // namespace terrainloop::gp
