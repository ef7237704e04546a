#pragma once

#include <stdexcept>
#include <string>

#include "terrainloop/image.hpp"

namespace terrainloop {

template <typename T>
void check(const ImageView<T>& image, const char* name) {
  const bool empty = image.rows == 0 || image.cols == 0;
  if (image.rows < 0 || image.cols < 0 || (!image.data && !empty))
    throw std::invalid_argument(std::string(name) + " must have pixels and no negative size");
}

template <typename T, typename U>
bool same_shape(const ImageView<T>& a, const ImageView<U>& b) {
  return a.rows == b.rows && a.cols == b.cols;
}

}  // namespace terrainloop
