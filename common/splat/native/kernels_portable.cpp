#include "simd_portable.hpp"
//
#include "kernels.hpp"

namespace vtslam::native {
extern const Kernels kPortableKernels;
const Kernels kPortableKernels = kernel_table("portable");
}  // namespace vtslam::native
