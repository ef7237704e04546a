#pragma once

#include <cstddef>
#include <vector>

namespace terrainloop::search {

/// Groups of rotations that are transformed side by side, one a lane.
constexpr int kLanes = 8;

/// Spectra of a turned field, as `correlate` reads them. Rotation (block * kLanes + lane) * turns + turn
/// stands at lane `lane` of fields[block][turn]; a group of `turns` rotations shares one ground. Conjugate;
/// half spectra (size x (size / 2 + 1)), the real lanes of a wave before the imaginary ones.
struct TurnedSpectra {
  const float* fields;  ///< [blocks][turns][x, y][size][size / 2 + 1][re, im][kLanes]
  const float* ground;  ///< [blocks][known, energy][size][size / 2 + 1][re, im][kLanes]
  int blocks, turns;
};

/// Conjugate half spectra of square real images, zero beyond their extent, in the order that TurnedSpectra
/// has: from [blocks * kLanes][turns][2][extent][extent] to [blocks][turns][2][size][size / 2 + 1][re,
/// im][kLanes].
std::vector<float> conjugate_spectra(const float* images, int blocks, int turns, int extent, int size);

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
/// `stored` holds the half spectra of the target, interleaved complex: x, y, known ground, energy. The mean
/// of r^2 times the shared pixels over a rotation is the size of one independent sample; a pose is evident
/// where r > 0 and r^2 exceeds `evident` times what that gives. `size` must be even, with no factors but 2,
/// 3, 5.
Correlations correlate(const TurnedSpectra& source, const float* stored, int size, double least_shared,
                       double evident);

}  // namespace terrainloop::search
