#pragma once

#include <cstddef>
#include <vector>

namespace terrainloop::search {

/// Rotations that are tried side by side, one a lane.
constexpr int kLanes = 8;

/// Spectra of a turned field, as `correlate` reads them: those of rotation block * kLanes + lane at that
/// lane. Conjugate half spectra (n x (n / 2 + 1)), the real lanes of a wave before the imaginary ones; n is
/// the size of the search for the fields, and half of it for the ground, which is summed over 2 x 2 pixels.
struct TurnedSpectra {
  const float* fields;  ///< [blocks][x, y][n][n / 2 + 1][re, im][kLanes]
  const float* ground;  ///< [blocks][known, energy][n][n / 2 + 1][re, im][kLanes]
  int blocks;
};

/// Half spectra of the field that is stored, interleaved complex, of the same sizes.
struct StoredSpectra {
  const float* field;   ///< [x, y][n][n / 2 + 1][re, im]
  const float* ground;  ///< [known, energy][n][n / 2 + 1][re, im]
};

/// Conjugate half spectra of pairs of square real images, zero beyond their extent, in the order of
/// TurnedSpectra: from [blocks * kLanes][2][extent][extent] to [blocks][2][size][size / 2 + 1][re,
/// im][kLanes].
std::vector<float> conjugate_spectra(const float* images, int blocks, int extent, int size);

struct Pose {
  int rotation, row, column;
  float squared_correlation;
  float samples;  ///< independent ones in the shared ground
};

struct Correlations {
  std::vector<Pose> evident;  ///< poses better than those beside them, whose r^2 stands out
  std::vector<double>
      sample;  ///< of each rotation: pixels that count as one sample, NaN if none could be tried
  std::vector<double> admissible;  ///< of each rotation: shifts that share enough ground
};

/// Correlation of two fields at every rotation and at every (cyclic) shift that shares enough ground.
///
/// The mean of r^2 times the shared pixels over a rotation is the size of one independent sample; a pose is
/// evident where r > 0 and r^2 exceeds `evident` times what that gives. Shared ground and energies, which are
/// smooth over the shifts, are interpolated from every second one. `size` must be a multiple of 4, with no
/// factors but 2, 3, 5.
Correlations correlate(const TurnedSpectra& source, const StoredSpectra& stored, int size,
                       double least_shared, double evident);

}  // namespace terrainloop::search
