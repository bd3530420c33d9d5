#include "tied_points.hpp"

namespace vtslam {

bool tied_points(const Ties& ties, const TieTables& tables, const TiedCamera& camera, double depth_unit_m, float* out) {
  const uint32_t width = static_cast<uint32_t>(camera.width);
  for (size_t i = 0; i < ties.count; ++i) {
    const size_t frame = ties.frame_index[i], subpixel = ties.subpixel[i];
    if (frame >= tables.frames || subpixel >= tables.offsets) return false;
    const uint32_t pixel = static_cast<uint32_t>(ties.pixel[i]);
    const uint32_t row = pixel / width, column = pixel - row * width;
    const double z = ties.depth[i] * depth_unit_m;
    const double x = (column + 0.5 + tables.offsets_px[2 * subpixel] - camera.cx) / camera.fx * z;
    const double y = (row + 0.5 + tables.offsets_px[2 * subpixel + 1] - camera.cy) / camera.fy * z;
    const double* T = tables.poses + 16 * frame;
    for (int k = 0; k < 3; ++k) {
      out[3 * i + k] = static_cast<float>(T[4 * k] * x + T[4 * k + 1] * y + T[4 * k + 2] * z + T[4 * k + 3]);
    }
  }
  return true;
}

}  // namespace vtslam
