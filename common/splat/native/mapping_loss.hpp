// The fused mapping loss and the optimiser step, spread over threads.
#pragma once

#include "types.hpp"

namespace vtslam::native {

struct LossInputs {
  int width, height;
  const float *rgb, *depth, *target_rgb, *target_depth;
  const uint8_t* mask;  // null: all pixels count
  double weight_color, weight_depth, ssim_share;
};

// Unweighted terms; the loss is weight_color ((1 - share) color + share (1 - ssim)) + weight_depth depth.
struct LossTerms {
  double color, ssim, depth;
};

LossTerms mapping_loss(const LossInputs& inputs, int threads, float* d_rgb, float* d_depth);

void adam_step(const AdamArgs& args, size_t count, int threads);

}  // namespace vtslam::native
