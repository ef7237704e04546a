#include "solve.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>

namespace terrainloop::gp {
namespace {

constexpr int kMaxSteps = 40;
constexpr double kTolerance =
    5e-4;  // a correction, as a share of the solution; the error left is far smaller
constexpr double kNegligible = 1e-7;  // a correction, as a share of the prior's deviation

/// Size of the slopes that the weights represent.
double roughness(const RowMatrix& w) {
  return std::sqrt((w.rightCols(w.cols() - 1) - w.leftCols(w.cols() - 1)).squaredNorm() +
                   (w.bottomRows(w.rows() - 1) - w.topRows(w.rows() - 1)).squaredNorm());
}

RowMatrix precondition(const std::vector<Subdomain>& subdomains, const RowMatrix& residual,
                       ThreadPool& workers) {
  std::vector<RowMatrix> parts(subdomains.size());
  workers.run(static_cast<int>(parts.size()), [&](int i) { parts[i] = subdomains[i].solve(residual); });
  RowMatrix sum = RowMatrix::Zero(residual.rows(), residual.cols());
  for (std::size_t i = 0; i < parts.size(); ++i)
    sum.block(subdomains[i].rows().first_knot, subdomains[i].cols().first_knot, parts[i].rows(),
              parts[i].cols()) += parts[i];
  return sum;
}

RowMatrix product(const Information& information, const Precision& precision, const RowMatrix& w,
                  ThreadPool& workers) {
  RowMatrix out = precision.rows * w * precision.cols / precision.variance;
  information.add_product(w, out, workers);
  return out;
}

double dot(const RowMatrix& a, const RowMatrix& b) { return a.cwiseProduct(b).sum(); }

}  // namespace

RowMatrix solve_weights(const Information& information, const Precision& precision,
                        const std::vector<Subdomain>& subdomains, ThreadPool& workers) {
  RowMatrix residual = information.vector();
  RowMatrix w = RowMatrix::Zero(residual.rows(), residual.cols());
  if (residual.isZero(0.0)) return w;
  // Where the ground is flat to rounding there is no solution to compare a correction with.
  const double negligible = kNegligible * std::sqrt(precision.variance * static_cast<double>(w.size()));
  std::vector<RowMatrix> steps, products;
  for (int k = 0; k < kMaxSteps; ++k) {
    RowMatrix step = precondition(subdomains, residual, workers);
    const double correction = roughness(step), whole = roughness(w + step);
    if (correction <= std::max(kTolerance * whole, negligible)) return w + step;
    for (std::size_t i = 0; i < steps.size(); ++i) step -= dot(step, products[i]) * steps[i];
    RowMatrix image = product(information, precision, step, workers);
    const double energy = dot(step, image);
    if (!(energy > 0.0) || !std::isfinite(energy)) break;
    steps.push_back(step / std::sqrt(energy));
    products.push_back(image / std::sqrt(energy));
    const double length = dot(residual, steps.back());
    w += length * steps.back();
    residual -= length * products.back();
  }
  throw std::runtime_error("the equations of the weights did not converge");
}

}  // namespace terrainloop::gp
