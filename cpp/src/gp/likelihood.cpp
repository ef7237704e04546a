#include "terrainloop/likelihood.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <stdexcept>
#include <utility>

#include "checks.hpp"
#include "prior.hpp"
#include "thread_pool.hpp"
#include "triangular.hpp"

namespace terrainloop::gp {
namespace {

using Vector = Eigen::VectorXd;

constexpr int kDegrees = 28;  // of the polynomials that the components along an axis are made of
constexpr int kMoments = 2 * kDegrees - 1;  // degrees of a product of two
constexpr int kNodes = 2 * kDegrees;        // of Gauss' quadrature, exact for products of four
constexpr double kLeftOut = 0.1;   // nats: twice what a block's points may contribute by components left out
constexpr double kJitter = 1e-11;  // variance of every component, as a share of the prior's
constexpr double kSpread[] = {0.75487766624669, 0.56984029099805};  // multiples fill the unit square evenly
constexpr std::size_t kChunk = 256;                                 // points at once
const double kLogTwoPi = std::log(2.0 * std::acos(-1.0));

// Eigen compiles new code for every form of expression: two of them keep the build short.
Matrix product(const Matrix& a, const Matrix& b) { return a * b; }
Matrix transposed_product(const Matrix& a, const Matrix& b) { return a.transpose() * b; }

/// B' A B
Matrix sandwich(const Matrix& a, const Matrix& b) { return product(transposed_product(b, a), b); }

/// Legendre polynomials on [-1, 1], orthonormal under the mean over it: (places, count).
Matrix legendre(const Vector& at, int count) {
  Matrix values(at.size(), count);
  values.col(0).setOnes();
  values.col(1) = at;
  for (int n = 1; n + 1 < count; ++n)
    values.col(n + 1) =
        (2.0 * n + 1.0) / (n + 1.0) * at.cwiseProduct(values.col(n)) - n / (n + 1.0) * values.col(n - 1);
  for (int n = 0; n < count; ++n) values.col(n) *= std::sqrt(2.0 * n + 1.0);
  return values;
}

/// Gauss' quadrature along an axis of a block.
struct Quadrature {
  Vector nodes;   ///< on [-1, 1]
  Matrix values;  ///< (nodes, moments) of the polynomials, times the root of the node's weight

  /// By the eigenvectors of the polynomials' recursion (Golub and Welsch).
  Quadrature() {
    Matrix recursion = Matrix::Zero(kNodes, kNodes);
    for (int n = 1; n < kNodes; ++n) recursion(n, n - 1) = n / std::sqrt(4.0 * n * n - 1.0);
    const Eigen::SelfAdjointEigenSolver<Matrix> solver(recursion);
    nodes = solver.eigenvalues();
    values = solver.eigenvectors().row(0).cwiseAbs().asDiagonal() * legendre(nodes, kMoments);
  }
};

/// The leading components of the prior on a block with unit sides: products of one along y and one along x.
struct Components {
  Matrix basis;                 ///< (degrees, p) of those along an axis, by polynomials
  std::vector<int> in_y, in_x;  ///< (r) of each product

  /// The components that leave out `rest` of the variance, by the eigenvectors of the covariance.
  Components(const Matrix& covariance, double rest) {
    const Eigen::SelfAdjointEigenSolver<Matrix> solver(covariance);
    const Vector shares = solver.eigenvalues().reverse();
    std::vector<int> order(kDegrees * kDegrees);
    std::iota(order.begin(), order.end(), 0);
    const auto share = [&](int k) { return shares[k / kDegrees] * shares[k % kDegrees]; };
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return share(a) > share(b); });
    double left = 1.0;
    for (const int k : order) {
      in_y.push_back(k / kDegrees);
      in_x.push_back(k % kDegrees);
      left -= share(k);
      if (left <= rest) break;
    }
    basis =
        solver.eigenvectors().rowwise().reverse().leftCols(*std::max_element(in_x.begin(), in_x.end()) + 1);
  }

  int rank() const { return static_cast<int>(in_x.size()); }

  Matrix product(const Matrix& along_y, const Matrix& along_x) const {
    return Matrix::NullaryExpr(rank(), rank(), [&](Eigen::Index i, Eigen::Index j) {
      return along_y(in_y[i], in_y[j]) * along_x(in_x[i], in_x[j]);
    });
  }
};

/// Index of the pair {i, j} in a list of all.
int pair(int i, int j) { return i < j ? pair(j, i) : i * (i + 1) / 2 + j; }

/// Twice the lower triangle, but once the diagonal: with another's lower triangle it gives tr(A B).
Matrix folded(const Matrix& symmetric) {
  Matrix result = 2.0 * Matrix(symmetric.triangularView<Eigen::Lower>());
  result.diagonal() *= 0.5;
  return result;
}

/// Points of a surface on a block centred on (x, y).
struct Patch {
  const Points* surface;
  std::vector<std::size_t> points;
  double x, y;
  double turn;  ///< in [0, 1), evenly distributed over the ground: those below a share are an even subset
};

/// Blocks of a grid over the middle of a surface, without those that hold no point.
void cut(const Points& surface, double side, std::vector<Patch>& patches) {
  double low[2], count[2];
  for (int axis : {0, 1}) {
    double high = low[axis] = surface.xy[axis];
    for (std::size_t i = 1; i < surface.count; ++i) {
      low[axis] = std::min(low[axis], surface.xy[2 * i + axis]);
      high = std::max(high, surface.xy[2 * i + axis]);
    }
    count[axis] = std::floor((high - low[axis]) / side) + 1.0;
    if (!(count[axis] < 1e9)) throw std::invalid_argument("the extent must be below a billion blocks");
    low[axis] -= 0.5 * (count[axis] * side - (high - low[axis]));
  }
  const auto cell = [&](std::size_t i, int axis) {
    return std::min(std::floor((surface.xy[2 * i + axis] - low[axis]) / side), count[axis] - 1.0);
  };
  std::vector<std::pair<double, std::size_t>> places(surface.count);
  for (std::size_t i = 0; i < surface.count; ++i) places[i] = {cell(i, 1) * count[0] + cell(i, 0), i};
  std::sort(places.begin(), places.end());
  for (std::size_t k = 0; k < places.size(); ++k) {
    const std::size_t i = places[k].second;
    if (k == 0 || places[k].first != places[k - 1].first) {
      const double row = cell(i, 1), col = cell(i, 0), turn = row * kSpread[1] + col * kSpread[0];
      patches.push_back(
          {&surface, {}, low[0] + (col + 0.5) * side, low[1] + (row + 0.5) * side, turn - std::floor(turn)});
    }
    patches.back().points.push_back(i);
  }
}

/// Sufficient statistics of the points of a block: phi' W phi, phi' W z, z' W z, sum log omega^2, with W =
/// diag(1 / omega^2).
struct Block {
  Matrix information;
  Vector vector;
  double square = 0.0, log_noise = 0.0;
  int points = 0;
};

/// The prior of the components' weights for unit variance.
struct Prior {
  Matrix precision, by_length_scale;  ///< and its derivative by the logarithm
  Matrix folded_precision, folded_by_length_scale;
  double log_determinant, trace;  ///< of the covariance; of the precision times the covariance's derivative
};

using Terms = Eigen::Array4d;

}  // namespace

struct BlockLikelihood::Statistics {
  Quadrature quadrature;
  double side;
  std::unique_ptr<Components> components;
  std::vector<Block> blocks;
  mutable ThreadPool workers;

  Statistics(double side, int threads) : side(side), workers(threads) {}

  /// Covariance along an axis of the polynomials' weights, and its derivative by log length_scale.
  std::array<Matrix, 2> covariance(double length_scale) const {
    const Matrix scaled = Matrix::NullaryExpr(kNodes, kNodes, [&](Eigen::Index i, Eigen::Index j) {
      const double d = 0.5 * side * (quadrature.nodes[i] - quadrature.nodes[j]) / length_scale;
      return d * d;
    });
    const Vector root = quadrature.values.col(0);
    const Matrix kernel = root.asDiagonal() * Matrix((-0.5 * scaled.array()).exp()) * root.asDiagonal();
    const Matrix v = quadrature.values.leftCols(kDegrees);
    return {sandwich(kernel, v), sandwich(kernel.cwiseProduct(scaled), v)};
  }

  /// Integrals of products of two components along an axis and a polynomial: (pairs, moments).
  Matrix triple_products() const {
    const Matrix values = product(quadrature.values.leftCols(kDegrees), components->basis);
    const int count = static_cast<int>(values.cols());
    Matrix products(count * (count + 1) / 2, kNodes);
    for (int i = 0; i < count; ++i)
      for (int j = 0; j <= i; ++j)
        products.row(pair(i, j)) =
            (values.col(i).array() * values.col(j).array() / quadrature.values.col(0).array()).matrix();
    return product(products, quadrature.values);
  }

  Prior prior(double length_scale) const;
  Block block(const Patch& patch, const Matrix& products) const;
  Terms terms(const Block& block, const Prior& prior, double variance, double noise) const;
};

Prior BlockLikelihood::Statistics::prior(double length_scale) const {
  auto [along, by_length_scale] = covariance(length_scale);
  along = sandwich(along, components->basis);
  by_length_scale = sandwich(by_length_scale, components->basis);
  Matrix c = components->product(along, along);
  c.diagonal().array() += kJitter;
  const Matrix dc = components->product(along, by_length_scale) + components->product(by_length_scale, along);
  const Eigen::LLT<Matrix> factor(c);
  if (factor.info() != Eigen::Success) throw std::runtime_error("the prior is not positive definite");
  Prior prior;
  prior.precision = factor.solve(Matrix::Identity(c.rows(), c.cols()));
  prior.by_length_scale = -product(product(prior.precision, dc), prior.precision);
  prior.folded_precision = folded(prior.precision);
  prior.folded_by_length_scale = folded(prior.by_length_scale);
  prior.log_determinant = 2.0 * factor.matrixLLT().diagonal().array().log().sum();
  prior.trace = prior.precision.cwiseProduct(dc).sum();
  return prior;
}

Block BlockLikelihood::Statistics::block(const Patch& patch, const Matrix& products) const {
  Block block;
  block.points = static_cast<int>(patch.points.size());
  Matrix moments = Matrix::Zero(kMoments, kMoments), first = Matrix::Zero(kDegrees, kDegrees);  // (y, x)
  for (std::size_t begin = 0; begin < patch.points.size(); begin += kChunk) {
    const auto count = static_cast<Eigen::Index>(std::min(kChunk, patch.points.size() - begin));
    Vector x(count), y(count), weight(count), weighted(count);
    for (Eigen::Index k = 0; k < count; ++k) {
      const std::size_t i = patch.points[begin + k];
      const double z = patch.surface->elevation[i], omega = patch.surface->noise[i];
      x[k] = 2.0 * (patch.surface->xy[2 * i] - patch.x) / side;
      y[k] = 2.0 * (patch.surface->xy[2 * i + 1] - patch.y) / side;
      weight[k] = 1.0 / std::max(omega * omega, std::numeric_limits<double>::min());
      weighted[k] = weight[k] * z;
      block.square += weighted[k] * z;
      block.log_noise += 2.0 * std::log(omega);
    }
    const Matrix in_x = legendre(x, kMoments), in_y = legendre(y, kMoments);
    moments += transposed_product(weight.asDiagonal() * in_y, in_x);
    first += transposed_product(weighted.asDiagonal() * in_y.leftCols(kDegrees), in_x.leftCols(kDegrees));
  }
  const Matrix pairs = product(product(products, moments), products.transpose());
  first = sandwich(first, components->basis);
  const std::vector<int>&in_y = components->in_y, &in_x = components->in_x;
  const int rank = components->rank();
  block.information = Matrix::NullaryExpr(rank, rank, [&](Eigen::Index i, Eigen::Index j) {
    return pairs(pair(in_y[i], in_y[j]), pair(in_x[i], in_x[j]));
  });
  block.vector = Vector::NullaryExpr(rank, [&](Eigen::Index i) { return first(in_y[i], in_x[i]); });
  return block;
}

Terms BlockLikelihood::Statistics::terms(const Block& block, const Prior& prior, double variance,
                                         double noise) const {
  const double s2 = std::max(noise * noise, std::numeric_limits<double>::min());
  const auto rank = static_cast<double>(prior.precision.rows());
  Matrix lower = prior.precision / variance + block.information / s2;
  const Eigen::LLT<Eigen::Ref<Matrix>> factor(lower);
  if (factor.info() != Eigen::Success || !lower.diagonal().allFinite())
    throw std::runtime_error("a covariance is not positive definite");
  const Vector mean = factor.solve(block.vector) / s2;
  const double log_determinant = 2.0 * lower.diagonal().array().log().sum();
  lower.triangularView<Eigen::StrictlyUpper>().setZero();
  invert_lower<double>(lower);
  const Matrix covariance = square(lower);
  const double trace = covariance.cwiseProduct(prior.folded_precision).sum() / variance;
  const double trace_by_length_scale = covariance.cwiseProduct(prior.folded_by_length_scale).sum() / variance;
  const double explained = block.vector.dot(mean) / s2;
  const double penalty = mean.dot(prior.precision * mean) / variance;
  const double misfit = block.square / s2 - explained - penalty;  // of the mean to the points
  const double twice = misfit + penalty + block.log_noise + log_determinant + prior.log_determinant +
                       rank * std::log(variance) + block.points * (2.0 * std::log(noise) + kLogTwoPi);
  const double by_length_scale =
      mean.dot(prior.by_length_scale * mean) / variance + trace_by_length_scale + prior.trace;
  return 0.5 *
         Terms(twice, by_length_scale, rank - penalty - trace, 2.0 * (block.points - misfit - rank + trace));
}

BlockLikelihood::BlockLikelihood(const std::vector<Points>& surfaces, const Hyperparameters& about,
                                 double noise, double side, double work, int threads) {
  for (const double value : {about.length_scale, about.variance, noise, side, work})
    if (!positive(value)) throw std::invalid_argument("numbers must be positive");
  check_threads(threads);
  if (surfaces.empty()) throw std::invalid_argument("there must be at least one surface");
  std::vector<Patch> patches;
  std::size_t count = 0;
  for (const Points& surface : surfaces) {
    check_points(surface);
    cut(surface, side, patches);
    count += surface.count;
  }
  auto statistics = std::make_unique<Statistics>(side, threads);
  const double rest = kLeftOut * noise * noise / about.variance * patches.size() / count;
  statistics->components = std::make_unique<Components>(statistics->covariance(about.length_scale)[0],
                                                        std::clamp(rest, 1e-9, 1e-2));
  const double most = work / std::pow(statistics->components->rank(), 3);
  if (most < patches.size()) {
    std::stable_sort(patches.begin(), patches.end(),
                     [](const Patch& a, const Patch& b) { return a.turn < b.turn; });
    patches.resize(std::max<std::size_t>(1, static_cast<std::size_t>(most)));
  }
  const Matrix products = statistics->triple_products();
  statistics->blocks.resize(patches.size());
  statistics->workers.run(static_cast<int>(patches.size()),
                          [&](int i) { statistics->blocks[i] = statistics->block(patches[i], products); });
  statistics_ = std::move(statistics);
}

BlockLikelihood::~BlockLikelihood() = default;

std::array<double, 4> BlockLikelihood::operator()(const Hyperparameters& parameters, double noise) const {
  for (const double value : {parameters.length_scale, parameters.variance, noise})
    if (!positive(value)) throw std::invalid_argument("numbers must be positive");
  const Prior prior = statistics_->prior(parameters.length_scale);
  const std::vector<Block>& blocks = statistics_->blocks;
  std::vector<Terms> terms(blocks.size());
  statistics_->workers.run(static_cast<int>(blocks.size()), [&](int i) {
    terms[i] = statistics_->terms(blocks[i], prior, parameters.variance, noise);
  });
  const Terms sum = std::accumulate(terms.begin(), terms.end(), Terms(Terms::Zero()));
  return {sum[0], sum[1], sum[2], sum[3]};
}

int BlockLikelihood::blocks() const { return static_cast<int>(statistics_->blocks.size()); }

int BlockLikelihood::rank() const { return statistics_->components->rank(); }

int BlockLikelihood::points() const {
  const auto add = [](int sum, const Block& block) { return sum + block.points; };
  return std::accumulate(statistics_->blocks.begin(), statistics_->blocks.end(), 0, add);
}

}  // namespace terrainloop::gp
