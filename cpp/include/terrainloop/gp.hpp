#pragma once

#include <cstddef>

/// The Gaussian process over the elevations of a cloud, from every point, in time linear in points and area.
///
/// Model: z_i = f(x_i, y_i) + n_i, n_i ~ N(0, s_i^2), f a zero-mean process with covariance
/// variance * exp(-d^2 / (2 length_scale^2)). docs/solver.md has the equations and the error budget.
namespace terrainloop::gp {

struct Hyperparameters {
  double length_scale;  ///< metres
  double variance;      ///< of f, metres squared
};

/// Training data; nothing is copied or kept.
struct Points {
  const double* xy;         ///< (count, 2) row-major, metres
  const double* elevation;  ///< (count), metres, near zero mean
  const double* noise;      ///< (count), standard deviation of each elevation, metres, > 0
  std::size_t count;
};

/// Pixel (row, col) is at (x + resolution * col, y + resolution * row).
struct Grid {
  double x, y, resolution;  ///< metres
  int rows, cols;
};

/// Output of the posterior, row-major (rows, cols) or (count); each may be null and is then not computed.
struct Maps {
  float* elevation;
  float* gradient_x;
  float* gradient_y;
  float* variance;           ///< of the elevation, metres squared
  float* gradient_variance;  ///< mean of the variances of the two components of the gradient
};

/// Posterior on a grid, with at most `threads` threads: no more than there are processors, and fewer if the
/// system refuses to start them. The result does not depend on their number, to the byte.
/// Memory, besides the arguments: 48 bytes per point and at most 0.7 GB, whatever the area.
/// Throws std::invalid_argument for numbers that do not define a model, std::runtime_error if the equations
/// cannot be solved to tolerance.
void predict_grid(const Points& points, const Hyperparameters& parameters, const Grid& grid, const Maps& maps,
                  int threads = 1);

/// As predict_grid, at `count` < 2^31 arbitrary positions: `queries` is (count, 2) row-major, metres.
void predict_at(const Points& points, const Hyperparameters& parameters, const double* queries,
                std::size_t count, const Maps& maps, int threads = 1);

/// Noise of each point as a share of that of a single typical one, from the points around it.
///
/// In square cells of side `cell` (metres; half a length scale, so that the ground in one is near a plane)
/// the robust scatter about a plane is taken and pooled with that of the cells around; where it grows, as
/// that of stereo does with the range, so does the ratio. Points further from their cell's plane than three
/// standard deviations have it raised by the square of the excess, so that flying pixels cause no spikes. The
/// n points in a square of half that side have it raised by sqrt(n), so that they count as one: the errors of
/// neighbours are correlated and do not average out. Where the points are too sparse to estimate a scatter,
/// only the last effect remains. A typical scatter below `smallest_scatter` (metres) counts as that value: on
/// quantised elevations most cells have none. `ratio` is (count). Memory grows with the points, whatever the
/// area. Throws std::invalid_argument for numbers that are not finite and for points over more than a million
/// cells along an axis.
void noise_ratio(const double* xy, const double* elevation, std::size_t count, double cell,
                 double smallest_scatter, double* ratio, int threads = 1);

}  // namespace terrainloop::gp
