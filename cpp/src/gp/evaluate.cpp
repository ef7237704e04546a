#include "evaluate.hpp"

#include <algorithm>
#include <cmath>

namespace terrainloop::gp {
namespace {

using Stencil = Eigen::Array<float, kSupport * kSupport, 1>;
using StencilMap = Eigen::Map<const Stencil>;

std::array<float, kSupport * kSupport> pair_table(const BasisRow& basis) {
  std::array<float, kSupport * kSupport> table{};
  for (int a = 0; a < kSupport; ++a)
    for (int b = a; b < kSupport; ++b) table[kSupport * a + b - a] = static_cast<float>(basis[a] * basis[b]);
  return table;
}

double dot(const BasisRow& basis, const double* values) {
  double sum = 0.0;
  for (int k = 0; k < kSupport; ++k) sum += basis[k] * values[k];
  return sum;
}

}  // namespace

Sample sample_at(int cell, double t, int index) {
  Sample sample{cell, index, basis_at(t), {}, {}};
  sample.values = pair_table(sample.basis.value);
  sample.slopes = pair_table(sample.basis.slope);
  return sample;
}

void evaluate_mean(const RowMatrix& weights, double spacing, Span rows, Span cols, const Maps& maps,
                   int stride) {
  if (cols.begin() == cols.end()) return;
  const int first = cols.begin()->cell, count = (cols.end() - 1)->cell - first + kSupport;
  Eigen::RowVectorXd value(count), slope(count);
  for (const Sample& row : rows) {
    const Eigen::Map<const Eigen::Matrix<double, 1, kSupport>> by(row.basis.value.data()),
        dy(row.basis.slope.data());
    value.noalias() = by * weights.block(row.cell, first, kSupport, count);
    slope.noalias() = dy * weights.block(row.cell, first, kSupport, count);
    for (const Sample& col : cols) {
      const std::size_t at = static_cast<std::size_t>(row.index) * stride + col.index;
      const double *v = value.data() + col.cell - first, *s = slope.data() + col.cell - first;
      if (maps.elevation) maps.elevation[at] = static_cast<float>(dot(col.basis.value, v));
      if (maps.gradient_x) maps.gradient_x[at] = static_cast<float>(dot(col.basis.slope, v) / spacing);
      if (maps.gradient_y) maps.gradient_y[at] = static_cast<float>(dot(col.basis.value, s) / spacing);
    }
  }
}

VarianceField::VarianceField(const Eigen::MatrixXf& covariance, const Subdomain& subdomain, double spacing,
                             double smallest)
    : subdomain_(subdomain),
      spacing_(spacing),
      smallest_(smallest),
      rows_(subdomain.rows().cells() + kDegree),
      cols_(subdomain.cols().cells() + kDegree),
      folded_(static_cast<std::size_t>(rows_) * cols_ * kSupport * kSupport, 0.0f) {
  for (int row = 0; row < rows_; ++row)
    for (int dr = 0; dr < std::min(kSupport, rows_ - row); ++dr) {
      float* out = &folded_[static_cast<std::size_t>(row * kSupport + dr) * cols_ * kSupport];
      for (int col = 0; col < cols_; ++col)
        for (int dc = 0; dc < std::min(kSupport, cols_ - col); ++dc) {
          const int low = row * cols_ + col, high = (row + dr) * cols_ + col;
          float sum = covariance(high + dc, low);
          if (dr > 0 && dc > 0) sum += covariance(high, low + dc);
          if (dr > 0 || dc > 0) sum *= 2.0f;
          out[col * kSupport + dc] = sum;
        }
    }
}

void VarianceField::evaluate(Span rows, Span cols, const Maps& maps, int stride) const {
  const int width = cols_ * kSupport;
  Eigen::ArrayXf values(width), slopes(width);
  const auto smallest = static_cast<float>(smallest_);
  const auto per_metre = static_cast<float>(0.5 / (spacing_ * spacing_));
  for (const Sample& row : rows) {
    values.setZero();
    slopes.setZero();
    const float* folded =
        &folded_[static_cast<std::size_t>(row.cell - subdomain_.rows().first_cell) * kSupport * width];
    for (int a = 0; a < kSupport; ++a)
      for (int d = 0; d < kSupport - a; ++d) {
        const Eigen::Map<const Eigen::ArrayXf> covariance(folded + (a * kSupport + d) * width, width);
        values += row.values[a * kSupport + d] * covariance;
        slopes += row.slopes[a * kSupport + d] * covariance;
      }
    for (const Sample& col : cols) {
      const int first = (col.cell - subdomain_.cols().first_cell) * kSupport;
      const StencilMap by_value(values.data() + first), by_slope(slopes.data() + first);
      const StencilMap value(col.values.data()), slope(col.slopes.data());
      const std::size_t at = static_cast<std::size_t>(row.index) * stride + col.index;
      if (maps.variance) maps.variance[at] = std::max(smallest, (by_value * value).sum());
      if (maps.gradient_variance)
        maps.gradient_variance[at] =
            per_metre * std::max(smallest, (by_value * slope + by_slope * value).sum());
    }
  }
}

}  // namespace terrainloop::gp
