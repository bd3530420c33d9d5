#include "simd_avx2.hpp"
//
#include "kernels.hpp"

namespace vtslam::native {
extern const Kernels kAvx2Kernels;
const Kernels kAvx2Kernels = kernel_table("avx2");
}  // namespace vtslam::native
