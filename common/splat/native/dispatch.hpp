// Choice of the instruction set at run time.
#pragma once

#include <string>
#include <vector>

#include "types.hpp"

namespace vtslam::native {

// The kernels in use: the best that the processor has, or the one named by VTSLAM_SIMD or by select_simd.
const Kernels& kernels();

// Names of the instruction sets that this processor and build can run, best first.
std::vector<std::string> available_simd();

// Switches to `name`; throws std::invalid_argument if it is not among available_simd().
void select_simd(const std::string& name);

}  // namespace vtslam::native
