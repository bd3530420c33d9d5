// Images of a town from a camera: colour and depth.
#pragma once

#include <cstdint>
#include <vector>

#include "town.hpp"

namespace city {

// The first textures of a town's table have these duties; bodies may use any.
enum SharedTexture : int { kStains = 0, kAsphalt = 1, kPaving = 2, kGrass = 3, kClouds = 4, kNumShared = 5 };

struct View {
  int width, height;
  double fx, fy, cx, cy;  // pixels; centres of pixels at half-integers
  Point position;
  Point right, down, forward;  // camera axes
};

struct Images {
  std::uint8_t* rgb;  // height x width x 3
  double* depth_m;    // height x width, along the optical axis, of the ray through the pixel centre; 0 = nothing hit
};

// Depth is exact. Colour is the mean over the pixel: textures are filtered by its footprint, and 2x2 rays are cast
// where faces meet.
void render(const Town& town, const std::vector<Body>& moving, const View& view, int num_threads, const Images& out);

}  // namespace city
