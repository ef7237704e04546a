#pragma once

#include <array>
#include <memory>
#include <vector>

#include "terrainloop/gp.hpp"

namespace terrainloop::gp {

/// The likelihood of hyperparameters, from every point of square blocks of ground, taken as independent draws
/// from the prior.
///
/// On a block the prior is represented by its leading r principal components (Karhunen and Loeve), so that
/// the points enter only through sums that are computed once, and an evaluation costs r^3 per block, whatever
/// their number.
class BlockLikelihood {
 public:
  /// The noise of a point is `noise` times that of its surface, which is then relative. `about` and `noise`
  /// choose the components: they hold for these length scale and ratio of variance and noise, or for longer
  /// and smaller ones. `side` of a block is in metres. Where the sum of r^3 exceeds `work`, an evenly
  /// spread subset of the blocks is used. Throws std::invalid_argument for numbers that do not define a
  /// model.
  BlockLikelihood(const std::vector<Points>& surfaces, const Hyperparameters& about, double noise,
                  double side, double work, int threads = 1);
  ~BlockLikelihood();

  /// -log p(z), and its derivatives by the logarithms of length scale, variance and noise. The result does
  /// not depend on the number of threads, to the byte. Concurrent calls are serialised. Throws
  /// std::invalid_argument for numbers that are not positive, std::runtime_error where a covariance cannot be
  /// factorised.
  std::array<double, 4> operator()(const Hyperparameters& parameters, double noise) const;

  int points() const;  ///< in the blocks
  int blocks() const;
  int rank() const;  ///< r

 private:
  struct Statistics;
  std::unique_ptr<const Statistics> statistics_;
};

}  // namespace terrainloop::gp
