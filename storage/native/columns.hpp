// Reversible rearrangements of a column's bytes that a fast general compressor gains from.
#pragma once

#include <cstddef>
#include <cstdint>

namespace vtslam {

// Bytes of `count` elements of `item` bytes, grouped by significance: all lowest bytes, then all next ones. With a
// `stride` above 0, of the differences to the element `stride` before (wrapping), signs folded into the lowest bit.
void split_planes(const uint8_t* in, uint8_t* out, size_t count, size_t item, size_t stride);
void join_planes(const uint8_t* in, uint8_t* out, size_t count, size_t item, size_t stride);

// round((value - low) / step), which must lie in 0 to 65535, and back.
void quantise(const float* in, uint16_t* out, size_t count, float low, float step);
void dequantise(const uint16_t* in, float* out, size_t count, float low, float step);

}  // namespace vtslam
