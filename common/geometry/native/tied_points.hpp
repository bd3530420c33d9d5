// Points tied to pixels of posed depth images. Knows nothing of Python.
#pragma once
#include <cstddef>
#include <cstdint>

namespace vtslam {

// A camera whose pixel centres are at half-integers.
struct TiedCamera {
  int32_t width;
  double fx, fy, cx, cy;  // pixels
};

// What each of `count` points is tied to.
struct Ties {
  const uint16_t* frame_index;
  const int32_t* pixel;  // row * width + column
  const uint8_t* subpixel;
  const uint16_t* depth;
  size_t count;
};

// Poses and offsets that ties refer to.
struct TieTables {
  const double* poses;  // [frames,4,4], row-major
  size_t frames;
  const float* offsets_px;  // [offsets,2], of a subpixel from its pixel's centre
  size_t offsets;
};

// Positions [count,3] in the poses' common coordinates; those of a row do not depend on other rows.
// False, with nothing to be used in `out`, if a tie refers to a pose or an offset that is not there.
bool tied_points(const Ties& ties, const TieTables& tables, const TiedCamera& camera, double depth_unit_m, float* out);

}  // namespace vtslam
