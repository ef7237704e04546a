#pragma once

#include <vector>

#include "subdomain.hpp"

namespace terrainloop::gp {

/// Prior precision of the weights, (rows (x) cols) / variance.
struct Precision {
  Matrix rows, cols;
  double variance;
};

/// Weights w with (precision + information) w = information.vector(), by conjugate gradients with the
/// subdomains as preconditioner. The steps are kept conjugate to all before, since a preconditioner that
/// weights each subdomain's share is not symmetric; each step still lowers the error in the energy norm.
///
/// Throws std::runtime_error unless the correction that the preconditioner makes of the last residual is
/// below the tolerance.
RowMatrix solve_weights(const Information& information, const Precision& precision,
                        const std::vector<Subdomain>& subdomains, ThreadPool& workers);

}  // namespace terrainloop::gp
