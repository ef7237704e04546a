#pragma once

#include <vector>

#include "gradient_field.hpp"

/// The two sides of a search: the source's field at every rotation and the target's field, as spectra.
namespace terrainloop::matching {

/// A field at evenly spaced rotations about the centroid of its observed area, as spectra that
/// `search::correlate` reads.
struct Query {
  int size;                         ///< of the FFT, pixels
  std::vector<Matrix3d> poses;      ///< of each rotation, from metres of the map to pixels of its image
  std::vector<float> fields, area;  ///< see search::TurnedSpectra
};

/// Half spectra of x and y, and of the valid area and energy on half the grid (see search::StoredSpectra).
struct StoredField {
  std::vector<float> field, area;
};

/// The FFT size on which two fields are correlated. Shifts at which only the rims of the maps overlap wrap
/// around. Throws std::invalid_argument where the fields are too large.
int search_size(const Field& source, const Field& target, const Calibration& calibration);

/// A source at rotations between which its ground moves by `rotation_step` pixels (RMS).
Query query_of(const Field& source, int size, const Calibration& calibration);

StoredField stored_field_of(const Field& target, int size);

}  // namespace terrainloop::matching
