// Depth images as numbers in a list of depths, coded without loss from their neighbours.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace vtslam {

struct ImageSize {
  int64_t images, height, width;
};

// `ranks` [images, height, width]: places in the sorted list of depths, 0 to `largest`.
std::vector<uint8_t> encode_depth_images(const int32_t* ranks, ImageSize size, int32_t largest);
void decode_depth_images(std::span<const uint8_t> bytes, int32_t* ranks, ImageSize size, int32_t largest);

}  // namespace vtslam
