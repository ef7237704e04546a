#include "statistics.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "cells.hpp"

namespace terrainloop::gp {
namespace {

/// Calls body(row) for every row, rows closer than a B-spline's support never at once: what they add to
/// shared entries is summed in the same order whatever the number of threads.
template <typename Body>
void striped(ThreadPool& workers, int rows, const Body& body) {
  for (int stripe = 0; stripe < std::min(kSupport, rows); ++stripe)
    workers.run((rows - stripe + kSupport - 1) / kSupport, [&](int i) { body(stripe + kSupport * i); });
}

constexpr int kPairs = kSupport * (kSupport + 1) / 2;  // unordered pairs of the functions on a cell
constexpr int kTurns = kSupport / 2 + 1;
constexpr int kBatch = 4;  // points that are added at once

/// Products of all pairs: entry kSupport * turn + a is that of the functions a and a + turn, modulo
/// kSupport; the last turn has each pair twice.
using PairProducts = Eigen::Array<double, kSupport * kTurns, 1>;

void pair_products(const BasisRow& basis, double scale, PairProducts& products) {
  double twice[2 * kSupport];
  for (int a = 0; a < kSupport; ++a) twice[a] = twice[a + kSupport] = basis[a];
  for (int turn = 0; turn < kTurns; ++turn)
    for (int a = 0; a < kSupport; ++a) products[kSupport * turn + a] = scale * basis[a] * twice[a + turn];
}

struct Pair {
  int entry, first, offset;
};

/// Each pair once.
constexpr std::array<Pair, kPairs> list_pairs() {
  std::array<Pair, kPairs> pairs{};
  int count = 0;
  for (int turn = 0; turn < kTurns; ++turn)
    for (int a = 0; a < (2 * turn == kSupport ? turn : kSupport); ++a) {
      const int other = (a + turn) % kSupport;
      pairs[count++] = {kSupport * turn + a, other < a ? other : a, other < a ? a - other : other - a};
    }
  return pairs;
}

constexpr std::array<Pair, kPairs> kPairList = list_pairs();

/// Adds pair products to the entries of their offsets, which are `stride` apart (the compiler unrolls it).
template <int turn = 0>
void add_turns(const double* products, double* entries, int stride) {
  if constexpr (turn < kTurns) {
    for (int a = 0; a < kSupport - turn; ++a) entries[turn * stride + a] += products[kSupport * turn + a];
    if constexpr (turn > 0 && 2 * turn < kSupport)
      for (int a = 0; a < turn; ++a)
        entries[(kSupport - turn) * stride + a] += products[kSupport * (turn + 1) - turn + a];
    add_turns<turn + 1>(products, entries, stride);
  }
}

}  // namespace

BinnedPoints bin(const Points& points, const Lattice& lattice) {
  SortedCells cells = sort_into_cells(points.xy, points.count,
                                      {lattice.x, lattice.y, lattice.spacing, lattice.rows, lattice.cols});
  BinnedPoints binned{{}, std::move(cells.first)};
  binned.points.reserve(cells.indices.size());
  for (const std::size_t i : cells.indices) {
    const int row = cells.of_point[i] / lattice.cols, col = cells.of_point[i] % lattice.cols;
    const double noise = points.noise[i];
    binned.points.push_back({(points.xy[2 * i] - lattice.x) / lattice.spacing - col,
                             (points.xy[2 * i + 1] - lattice.y) / lattice.spacing - row, points.elevation[i],
                             1.0 / std::max(noise * noise, std::numeric_limits<double>::min())});
  }
  return binned;
}

Information::Information(const BinnedPoints& binned, const Lattice& lattice, ThreadPool& workers)
    : cols_(lattice.knot_cols()),
      matrix_(static_cast<std::size_t>(lattice.knot_rows()) * kSupport * kSupport * cols_, 0.0),
      vector_(RowMatrix::Zero(lattice.knot_rows(), cols_)) {
  striped(workers, lattice.rows, [&](int row) {
    for (int col = 0; col < lattice.cols; ++col) {
      const std::size_t cell = static_cast<std::size_t>(row) * lattice.cols + col;
      if (binned.first[cell] != binned.first[cell + 1])
        add_cell(row, col, binned.points.data() + binned.first[cell],
                 binned.points.data() + binned.first[cell + 1]);
    }
  });
}

void Information::add_cell(int row, int col, const CellPoint* begin, const CellPoint* end) {
  PairProducts sums[kPairs];  // over the pairs in y; each over those in x
  Eigen::Array<double, kSupport, kSupport> vector = Eigen::Array<double, kSupport, kSupport>::Zero();
  for (PairProducts& sum : sums) sum.setZero();
  for (const CellPoint* first = begin; first < end; first += kBatch) {
    PairProducts in_x[kBatch], in_y[kBatch];
    for (int k = 0; k < kBatch; ++k) {
      const CellPoint point = first + k < end ? first[k] : CellPoint{0.0, 0.0, 0.0, 0.0};
      const BasisRow bx = basis_at(point.u).value, by = basis_at(point.v).value;
      pair_products(bx, point.weight, in_x[k]);
      pair_products(by, 1.0, in_y[k]);
      const Eigen::Map<const Eigen::Array<double, kSupport, 1>> along_x(bx.data());
      for (int b = 0; b < kSupport; ++b) vector.col(b) += point.weight * point.elevation * by[b] * along_x;
    }
    for (int pair = 0; pair < kPairs; ++pair) {
      const int entry = kPairList[pair].entry;
      sums[pair] += in_y[0][entry] * in_x[0] + in_y[1][entry] * in_x[1] + in_y[2][entry] * in_x[2] +
                    in_y[3][entry] * in_x[3];
    }
  }
  for (int b = 0; b < kSupport; ++b)
    for (int a = 0; a < kSupport; ++a) vector_(row + b, col + a) += vector(a, b);
  for (int pair = 0; pair < kPairs; ++pair)
    add_turns(sums[pair].data(),
              &matrix_[index(row + kPairList[pair].first, kPairList[pair].offset, 0) + col], cols_);
}

void Information::add_product(const RowMatrix& w, RowMatrix& out, ThreadPool& workers) const {
  const int rows = static_cast<int>(w.rows());
  using Row = Eigen::Map<const Eigen::ArrayXd>;
  striped(workers, rows, [&](int row) {
    const auto along = [&](const double* entries, const double* from, double* to, Eigen::Index count) {
      Eigen::Map<Eigen::ArrayXd>(to, count) += Row(entries, count) * Row(from, count);
    };
    for (int below = 0; below < std::min(kSupport, rows - row); ++below)
      for (int right = 0; right < std::min(kSupport, cols_); ++right) {
        const double* entries = at(row, below, right);
        const Eigen::Index count = cols_ - right;
        along(entries, &w(row + below, right), &out(row, 0), count);
        if (below > 0 || right > 0) along(entries, &w(row, 0), &out(row + below, right), count);
        if (below == 0 || right == 0) continue;
        along(entries, &w(row, right), &out(row + below, 0), count);
        along(entries, &w(row + below, 0), &out(row, right), count);
      }
  });
}

}  // namespace terrainloop::gp
