#pragma once

#include <vector>

#include "se2.hpp"
#include "terrainloop/match.hpp"

namespace terrainloop::matching {

/// A gradient field on a coarse grid: mean subtracted, weighted by its variance, whitened, soft-clipped.
struct Field {
  int rows, cols;
  std::vector<float> x, y;    ///< in robust deviations, 0 where the ground was not observed
  std::vector<float> valid;   ///< 1 where it was, else 0
  double origin_x, origin_y;  ///< of pixel (0, 0), metres
  double spacing, length_scale;
  Vector2d centre = Vector2d::Zero();  ///< centroid of the observed area, metres
  double radius = 0.0;                 ///< root mean square distance of the observed area from it, metres
  int diameter = 0;  ///< side, in pixels, of a square that holds the observed area at every rotation

  Matrix3d metres_from_pixels() const { return matching::metres_from_pixels(origin_x, origin_y, spacing); }
  ImageView<float> image(const std::vector<float>& pixels) const { return {pixels.data(), rows, cols}; }
};

/// Metres per pixel at which a map is searched: a share of the length scale, doubled for large maps.
double field_spacing(const GradientMapView& map, const Calibration& calibration);

/// The field of a map, averaged over pixels of `spacing` metres. The mean slope is subtracted, since gravity
/// is never known exactly, and gradients are weighted down where their variance is high.
Field field_of(const GradientMapView& map, double spacing, const Calibration& calibration);

/// Flattens the spectrum: the field through the filter 1 / sqrt(P + floor mean P), with P its smoothed power
/// spectrum, because the waves that dominate it, such as ripples or a long slope, identify the place least.
void whiten(Field& field, const Calibration& calibration);

}  // namespace terrainloop::matching
