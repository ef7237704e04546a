#pragma once

#include <array>
#include <cstddef>
#include <vector>

#include "bspline.hpp"
#include "prior.hpp"
#include "terrainloop/gp.hpp"
#include "thread_pool.hpp"

/// The information of the points on the weights of the spline.
namespace terrainloop::gp {

using RowMatrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

/// A lattice of knots; cell (row, col) spans knots row + 3 .. row + 4, and has the weights of the knots
/// row .. row + 7 (the same along x).
struct Lattice {
  double x, y;     ///< corner of cell (0, 0), metres
  double spacing;  ///< metres
  int rows, cols;  ///< cells

  int knot_rows() const { return rows + kDegree; }
  int knot_cols() const { return cols + kDegree; }
};

/// A point relative to its cell, with 1 / noise^2 as its weight.
struct CellPoint {
  double u, v;  ///< within the cell, [0, 1]
  double elevation, weight;
};

/// The points of a lattice, cell by cell (row-major), in their original order within a cell.
struct BinnedPoints {
  std::vector<CellPoint> points;
  std::vector<std::size_t> first;  ///< of each cell, and one past the last
};

/// The points on the lattice, which is closed at its upper borders.
BinnedPoints bin(const Points& points, const Lattice& lattice);

/// Information matrix Phi' W Phi and vector Phi' W z of the weights.
///
/// A product of B-splines depends on the unordered pair of knots in each axis only, so the entry of the
/// knots (i, j) and (i', j') is stored once, at (min(i, i'), min(j, j')) and the offsets |i - i'|, |j - j'|.
class Information {
 public:
  Information(const BinnedPoints& binned, const Lattice& lattice, ThreadPool& workers);

  /// Entries of the pairs that begin at the knots of a row and have these offsets, by column.
  const double* at(int row, int row_offset, int col_offset) const {
    return &matrix_[index(row, row_offset, col_offset)];
  }
  /// Phi' W z, (knot rows, knot cols).
  const RowMatrix& vector() const { return vector_; }
  /// out += Phi' W Phi w.
  void add_product(const RowMatrix& w, RowMatrix& out, ThreadPool& workers) const;

 private:
  std::size_t index(int row, int row_offset, int col_offset) const {
    return ((static_cast<std::size_t>(row) * kSupport + row_offset) * kSupport + col_offset) * cols_;
  }
  void add_cell(int row, int col, const CellPoint* begin, const CellPoint* end);

  int cols_;
  std::vector<double> matrix_;
  RowMatrix vector_;
};

}  // namespace terrainloop::gp
