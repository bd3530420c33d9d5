// A tiling texture with its mip chain, and the footprint-filtered look-up.
#pragma once

#include <cstdint>
#include <vector>

namespace raycast {

// Red, green, blue and an unused lane. A compiler vector: element-wise, the same result on every machine.
using Rgb = float __attribute__((vector_size(16)));

// The parallelogram on the texture that one sample stands for, in texture units (1 = the whole width or height).
struct Footprint {
  float du_dx, dv_dx, du_dy, dv_dy;
};

class Texture {
 public:
  // rgb: height x width x 3 bytes; both sizes must be powers of two (the caller checks).
  Texture(const std::uint8_t* rgb, int height, int width);

  // Mean colour (0..255) over the footprint around (u, v): trilinear, with several probes along its longer side.
  Rgb sampled(float u, float v, const Footprint& footprint) const;

 private:
  struct Level {
    int width, height;
    std::vector<std::uint32_t> texels;  // r | g << 8 | b << 16
  };
  static Rgb bilinear(const Level& level, float u, float v);
  Rgb trilinear(float u, float v, float lod) const;

  std::vector<Level> levels_;
};

}  // namespace raycast
