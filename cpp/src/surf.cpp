#include "terrainloop/surf.hpp"

#include <algorithm>
#include <tuple>

#include "fast_hessian.hpp"
#include "surf_descriptor.hpp"
#include "terrainloop/integral_image.hpp"

namespace terrainloop::surf {
namespace {

bool stronger(const Keypoint& a, const Keypoint& b) {
  return std::make_tuple(-a.response, a.y, a.x, a.scale) < std::make_tuple(-b.response, b.y, b.x, b.scale);
}

}  // namespace

Features extract(ImageView<float> image, ImageView<std::uint8_t> mask, const Settings& settings) {
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

}  // namespace terrainloop::surf
