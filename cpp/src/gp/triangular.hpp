#pragma once

#include <Eigen/Dense>
#include <algorithm>

/// Inverses by triangular matrices, in products of blocks: several times as fast as by their columns.
namespace terrainloop::gp {

template <typename Scalar>
using DenseMatrix = Eigen::Matrix<Scalar, Eigen::Dynamic, Eigen::Dynamic>;

/// In place, the inverse of a lower triangular matrix whose upper triangle is zero.
template <typename Scalar>
void invert_lower(Eigen::Ref<DenseMatrix<Scalar>> lower) {
  const Eigen::Index n = lower.rows();
  if (n <= 32) {
    DenseMatrix<Scalar> result = DenseMatrix<Scalar>::Identity(n, n);
    lower.template triangularView<Eigen::Lower>().solveInPlace(result);
    lower = result;
    return;
  }
  const Eigen::Index half = (n / 2 + 7) / 8 * 8;
  auto corner = lower.bottomLeftCorner(n - half, half);
  invert_lower<Scalar>(lower.topLeftCorner(half, half));
  invert_lower<Scalar>(lower.bottomRightCorner(n - half, n - half));
  const DenseMatrix<Scalar> inner =
      corner * lower.topLeftCorner(half, half).template triangularView<Eigen::Lower>();
  corner.noalias() = -(lower.bottomRightCorner(n - half, n - half) * inner);
}

/// Lower triangle of V' V for a lower triangular V; the diagonal blocks are whole.
template <typename Scalar>
DenseMatrix<Scalar> square(const DenseMatrix<Scalar>& v) {
  constexpr Eigen::Index kBlock = 64;  // columns at a time, so that a product's operands stay in cache
  const Eigen::Index n = v.rows();
  DenseMatrix<Scalar> result = DenseMatrix<Scalar>::Zero(n, n);
  for (Eigen::Index i = 0; i < n; i += kBlock) {
    const Eigen::Index width = std::min<Eigen::Index>(kBlock, n - i);
    result.block(i, 0, width, i + width).noalias() =
        v.block(i, i, n - i, width).transpose() * v.block(i, 0, n - i, i + width);
  }
  return result;
}

}  // namespace terrainloop::gp
