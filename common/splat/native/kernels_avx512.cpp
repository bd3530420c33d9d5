#include "simd_avx512.hpp"
//
#include "kernels.hpp"

namespace vtslam::native {
extern const Kernels kAvx512Kernels;
const Kernels kAvx512Kernels = kernel_table("avx512");
}  // namespace vtslam::native
