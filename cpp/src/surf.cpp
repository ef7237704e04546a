#include "terrainloop/surf.hpp"

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <tuple>

#include "fast_hessian.hpp"
#include "image_checks.hpp"
#include "integral_image.hpp"
#include "surf_descriptor.hpp"

namespace terrainloop::surf {
namespace {

bool stronger(const Keypoint& a, const Keypoint& b) {
  return std::make_tuple(-a.response, a.y, a.x, a.scale) < std::make_tuple(-b.response, b.y, b.x, b.scale);
}

void check(const ImageView<float>& image) {
  terrainloop::check(image, "image");
  if (!std::all_of(image.data, image.data + static_cast<std::size_t>(image.rows) * image.cols,
                   [](float v) { return std::isfinite(v); }))
    throw std::invalid_argument("image must be finite");
}

}  // namespace

Features extract(ImageView<float> image, ImageView<std::uint8_t> mask, const Settings& settings) {
  check(image);
  if (mask.data && !same_shape(image, mask)) throw std::invalid_argument("mask must have the shape of image");
  if (!(settings.threshold >= 0.0)) throw std::invalid_argument("threshold must be >= 0");
  if (settings.octaves < 1 || settings.octaves > 16)
    throw std::invalid_argument("octaves must be within 1..16");
  if (settings.intervals < 3 || settings.intervals > 16)
    throw std::invalid_argument("intervals must be within 3..16");
  const IntegralImage integral(image);
  Features features{detect(integral, mask, settings), {}};
  std::sort(features.keypoints.begin(), features.keypoints.end(), stronger);
  if (features.keypoints.size() > settings.max_keypoints) features.keypoints.resize(settings.max_keypoints);
  features.descriptors.reserve(features.keypoints.size());
  for (Keypoint& keypoint : features.keypoints) {
    keypoint.orientation = dominant_orientation(integral, keypoint.x, keypoint.y, keypoint.scale);
    features.descriptors.push_back(describe(integral, keypoint));
  }
  return features;
}

std::vector<double> fast_hessian(ImageView<float> image, int filter_size) {
  check(image);
  if (filter_size < 9 || filter_size % 6 != 3)
    throw std::invalid_argument("filter_size must be 9, 15, 21, ...");
  return response_map(IntegralImage(image), filter_size);
}

}  // namespace terrainloop::surf
