#include "statistics.hpp"

#include <algorithm>
#include <cmath>

namespace terrainloop::gp {
namespace {

/// Calls body(row) for every row, those that lie closer than a B-spline's support never at once: what they
/// add to shared places is summed in the same order whatever the number of threads.
template <typename Body>
void striped(Workers& workers, int rows, const Body& body) {
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
    for (int a = 0; a < kSupport; ++a)
      products[kSupport * turn + a] = scale * basis[a] * twice[a + turn];
}

struct Pair {
  int entry, first, offset;
};

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

}  // namespace

BinnedPoints bin(const Points& points, const Lattice& lattice) {
  const auto cell_of = [&](std::size_t i, double& u, double& v) -> long {
    u = (points.xy[2 * i] - lattice.x) / lattice.spacing;
    v = (points.xy[2 * i + 1] - lattice.y) / lattice.spacing;
    if (!(u >= 0.0 && v >= 0.0 && u <= lattice.cols && v <= lattice.rows)) return -1;
    const int col = std::min(static_cast<int>(u), lattice.cols - 1);
    const int row = std::min(static_cast<int>(v), lattice.rows - 1);
    u -= col;
    v -= row;
    return static_cast<long>(row) * lattice.cols + col;
  };
  BinnedPoints binned;
  binned.first.assign(static_cast<std::size_t>(lattice.rows) * lattice.cols + 1, 0);
  double u, v;
  for (std::size_t i = 0; i < points.count; ++i)
    if (const long cell = cell_of(i, u, v); cell >= 0) ++binned.first[cell + 1];
  for (std::size_t cell = 1; cell < binned.first.size(); ++cell) binned.first[cell] += binned.first[cell - 1];
  binned.points.resize(binned.first.back());
  std::vector<std::size_t> next(binned.first.begin(), binned.first.end() - 1);
  for (std::size_t i = 0; i < points.count; ++i)
    if (const long cell = cell_of(i, u, v); cell >= 0)
      binned.points[next[cell]++] = {u, v, points.elevation[i], 1.0 / (points.noise[i] * points.noise[i])};
  return binned;
}

Information::Information(const BinnedPoints& binned, const Lattice& lattice, Workers& workers)
    : cols_(lattice.knot_cols()),
      matrix_(static_cast<std::size_t>(lattice.knot_rows()) * cols_ * kStencil, 0.0),
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
  for (int pair = 0; pair < kPairs; ++pair) {
    double* out = &matrix_[kStencil * (static_cast<std::size_t>(row + kPairList[pair].first) * cols_ + col) +
                           kSupport * kPairList[pair].offset];
    for (const Pair& in_x : kPairList) out[kStencil * in_x.first + in_x.offset] += sums[pair][in_x.entry];
  }
}

void Information::add_product(const RowMatrix& w, RowMatrix& out, Workers& workers) const {
  const int rows = static_cast<int>(w.rows());
  striped(workers, rows, [&](int row) {
    for (int db = 0; db < std::min(kSupport, rows - row); ++db)
      for (int col = 0; col < cols_; ++col) {
        const double* entry = at(row, col) + kSupport * db;
        const int reach = std::min(kSupport, cols_ - col);
        const double *above = &w(row, col), *below = &w(row + db, col);
        double *out_above = &out(row, col), *out_below = &out(row + db, col);
        double sum_above = 0.0, sum_below = 0.0;
        for (int da = 0; da < reach; ++da) sum_above += entry[da] * below[da];
        if (db > 0) {
          for (int da = 0; da < reach; ++da) sum_below += entry[da] * above[da];
          for (int da = 1; da < reach; ++da) out_above[da] += entry[da] * below[0];
        }
        for (int da = 1; da < reach; ++da) out_below[da] += entry[da] * above[0];
        out_above[0] += sum_above;
        out_below[0] += sum_below;
      }
  });
}

}  // namespace terrainloop::gp
