// Images of a scene: colour, depth and the angle of view on the surface.
#pragma once

#include <cstdint>

#include "scene.hpp"

namespace raycast {

struct View {
  int width, height;
  double fx, fy, cx, cy;  // pixels; centres of pixels at half-integers
  Mat3 rotation;          // camera to world; camera axes x right, y down, z forward
  Vec3 position;          // world, m
};

struct Images {
  std::uint8_t* rgb;  // height x width x 3
  double* depth_m;    // height x width, along the optical axis, of the ray through the pixel centre; 0 = nothing hit
  float* cosine;      // height x width, of the angle between that ray and the surface normal, 0..1
};

// Depth is exact; colour is the mean over the pixel: 2x2 rays, 3x3 where they meet different faces.
void render(const Scene& scene, const View& view, int num_threads, const Images& out);

}  // namespace raycast
