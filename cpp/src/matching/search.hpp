#pragma once

#include <cstddef>
#include <vector>

namespace terrainloop::search {

/// Rotations that are processed side by side, one per lane.
constexpr int kLanes = 8;

/// Spectra of a rotated field in the layout of `correlate`: rotation block * kLanes + lane is at that lane.
/// Conjugate half spectra (n x (n / 2 + 1)), the real lanes of a frequency before the imaginary ones; n is
/// the size of the search for the fields, and half of it for area and energy, which are summed over 2 x 2
/// pixels.
struct TurnedSpectra {
  const float* fields;  ///< [blocks][x, y][n][n / 2 + 1][re, im][kLanes]
  const float* ground;  ///< [blocks][valid area, energy][n][n / 2 + 1][re, im][kLanes]
  int blocks;
};

/// Half spectra of the stored field, interleaved complex, of the same sizes.
struct StoredSpectra {
  const float* field;   ///< [x, y][n][n / 2 + 1][re, im]
  const float* ground;  ///< [valid area, energy][n][n / 2 + 1][re, im]
};

/// Conjugate half spectra of pairs of square real images, zero beyond their extent, in the order of
/// TurnedSpectra: from [blocks * kLanes][2][extent][extent] to [blocks][2][size][size / 2 + 1][re,
/// im][kLanes].
std::vector<float> conjugate_spectra(const float* images, int blocks, int extent, int size);

struct Pose {
  int rotation, row, column;
  float squared_correlation;
  float samples;  ///< number of independent samples in the shared area
};

struct Correlations {
  std::vector<Pose> evident;  ///< local maxima whose r^2 exceeds the threshold
  std::vector<double>
      sample;  ///< of each rotation: pixels that count as one sample, NaN if none could be tried
  std::vector<double> admissible;  ///< of each rotation: shifts with enough shared area
};

/// Correlation of two fields at every rotation and at every (cyclic) shift with enough shared area.
///
/// The mean of r^2 times the shared pixels over a rotation is the size of one independent sample; a pose is
/// evident where r > 0 and r^2 exceeds `evident` times its expected value. Shared area and energies, which
/// are smooth over the shifts, are interpolated from every second one. `size` must be a multiple of 4,
/// without prime factors other than 2, 3 and 5.
Correlations correlate(const TurnedSpectra& source, const StoredSpectra& stored, int size,
                       double least_shared, double evident);

}  // namespace terrainloop::search
