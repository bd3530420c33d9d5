// Periodic gradient noise, the raw material of all procedural textures.
#pragma once

#include <cstdint>

namespace raycast {

struct NoiseSettings {
  int height, width;     // output size, texels
  int cells_y, cells_x;  // lattice cells of the first octave across the output; doubled with each octave
  int octaves;           // octaves whose cells are under 2 texels are left out
  float gain;            // amplitude ratio of one octave to the one before
  std::uint32_t seed;
};

// Writes height x width floats, row-major, mean about 0; octave k has a standard deviation of about 0.83 gain^k.
// The output tiles without a seam in both directions.
void fractal_noise(const NoiseSettings& settings, int num_threads, float* out);

}  // namespace raycast
