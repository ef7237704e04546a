#pragma once

#include <array>

/// The uniform B-spline of degree 7 on a lattice of unit spacing.
namespace terrainloop::gp {

constexpr int kDegree = 7;
constexpr int kSupport = kDegree + 1;  ///< basis functions that are not zero on a cell

using BasisRow = std::array<double, kSupport>;

struct Basis {
  BasisRow value, slope;
};

/// The functions that are not zero on a cell, from the leftmost on, at t within [0, 1] of it; slopes are
/// per unit of the lattice (Cox - de Boor).
inline Basis basis_at(double t) {
  BasisRow b{1.0}, lower{};
  for (int d = 1; d <= kDegree; ++d) {
    lower = b;
    for (int j = d; j >= 0; --j)
      b[j] = ((j > 0 ? (t + d - j) * lower[j - 1] : 0.0) + (j < d ? (1.0 - t + j) * lower[j] : 0.0)) / d;
  }
  BasisRow slope;
  for (int j = 0; j <= kDegree; ++j)
    slope[j] = (j > 0 ? lower[j - 1] : 0.0) - (j < kDegree ? lower[j] : 0.0);
  return {b, slope};
}

}  // namespace terrainloop::gp
