// The table of one instruction set. Include a simd_*.hpp first.
#pragma once

#include "kernels_geometry.hpp"
#include "kernels_loss.hpp"
#include "kernels_raster.hpp"

namespace vtslam::native {
namespace {

constexpr Kernels kernel_table(const char* name) {
  return {name, project, forward_tile, backward_tile, chain, loss_statistics_row, loss_gradient_row, adam};
}

}  // namespace
}  // namespace vtslam::native
