#pragma once

#include <array>

/// The uniform B-spline of degree 7 on a lattice of unit spacing.
namespace terrainloop::gp {

constexpr int kDegree = 7;
constexpr int kSupport = kDegree + 1;  ///< basis functions that are nonzero on a cell

using BasisRow = std::array<double, kSupport>;

struct Basis {
  BasisRow value, slope;
};

/// Coefficients [power][function] of the functions as polynomials on a cell, from the leftmost on, by the
/// recursion of Cox and de Boor.
constexpr std::array<BasisRow, kSupport> basis_coefficients() {
  std::array<BasisRow, kSupport> c{}, lower{};
  c[0][0] = 1.0;
  for (int d = 1; d <= kDegree; ++d) {
    lower = c;
    for (int j = 0; j <= d; ++j)
      for (int p = 0; p <= d; ++p) {
        // ((t + d - j) lower_{j-1} + (1 - t + j) lower_j) / d
        double sum = 0.0;
        if (j > 0) sum += (d - j) * lower[p][j - 1] + (p > 0 ? lower[p - 1][j - 1] : 0.0);
        if (j < d) sum += (1 + j) * lower[p][j] - (p > 0 ? lower[p - 1][j] : 0.0);
        c[p][j] = sum / d;
      }
  }
  return c;
}

/// The functions that are nonzero on a cell, at t within [0, 1] of it; slopes are per unit of the lattice.
inline Basis basis_at(double t) {
  static constexpr std::array<BasisRow, kSupport> c = basis_coefficients();
  Basis basis{c[kDegree], {}};
  for (int p = kDegree - 1; p >= 0; --p)
    for (int j = 0; j < kSupport; ++j) {
      basis.slope[j] = basis.slope[j] * t + basis.value[j];
      basis.value[j] = basis.value[j] * t + c[p][j];
    }
  return basis;
}

}  // namespace terrainloop::gp
