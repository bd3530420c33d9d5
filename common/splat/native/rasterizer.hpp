// The rasteriser: what a rendering keeps for its derivative, and the two passes.
#pragma once

#include <memory>
#include <stdexcept>
#include <string>

#include "memory.hpp"
#include "types.hpp"

namespace vtslam::native {

struct Rendering;  // defined in rasterizer.cpp

struct Image {
  Buffer<float> rgb, depth, alpha;
};

// An input array has a value that is not finite, or out of range; found without saying where.
struct BadInput : std::runtime_error {
  using std::runtime_error::runtime_error;
};

struct GradientArrays {
  // Null where not wanted; the first three together, and weights only with them.
  float *colors, *log_radii, *opacity_logits, *means, *weights;
  double pose[6];
};

// Renders `count` Gaussians. Throws BadInput, or std::length_error if the scene needs too many (Gaussian, tile) pairs.
std::shared_ptr<Rendering> render(const SplatInputs& inputs, uint32_t count, const View& view, const Settings& settings,
                                  int threads, Image& image);

uint32_t splat_count(const Rendering& rendering);
const View& view_of(const Rendering& rendering);

// Pulls image derivatives back; d_alpha may be null. Throws BadInput.
void backward(const Rendering& rendering, const float* d_rgb, const float* d_depth, const float* d_alpha,
              bool want_attributes, bool want_geometry, int threads, GradientArrays& gradients);

}  // namespace vtslam::native
