#include "alignment.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "motion.hpp"

namespace vtslam {

int64_t visible_points(const ReferencePoints& map, const double R[9], const double t[3], const RenderedDepth& rendered,
                       float tolerance, float* packed) {
  const Motion motion(R, t);
  const Pinhole& camera = rendered.camera;
  int64_t kept = 0;
  for (int64_t i = 0; i < map.count; ++i) {
    const float* point = map.packed + 6 * i;
    const Point p = motion.moved({point[0], point[1], point[2]});
    if (!(p.z > 0.01f)) continue;
    const float u = camera.fx * p.x / p.z + camera.cx, v = camera.fy * p.y / p.z + camera.cy;
    if (!(u >= 0.0f && v >= 0.0f && u < rendered.width && v < rendered.height)) continue;
    const float d = rendered.depth[static_cast<size_t>(v) * rendered.width + static_cast<size_t>(u)];
    if (!(d > 0.0f && std::fabs(d - p.z) <= tolerance * p.z)) continue;
    const Point q = motion.rotated({point[3], point[4], point[5]});
    float* row = packed + 6 * kept++;
    row[0] = p.x;
    row[1] = p.y;
    row[2] = p.z;
    row[3] = q.x;
    row[4] = q.y;
    row[5] = q.z;
  }
  return kept;
}

namespace {

// Least squares of inverse depth as an affine function of the pixel, over a window: exact for planes.
struct PlaneFit {
  double n = 0, u = 0, v = 0, uu = 0, uv = 0, vv = 0, r = 0, ru = 0, rv = 0;

  void add(double du, double dv, double inverse_depth) {
    n += 1;
    u += du;
    v += dv;
    uu += du * du;
    uv += du * dv;
    vv += dv * dv;
    r += inverse_depth;
    ru += inverse_depth * du;
    rv += inverse_depth * dv;
  }

  // Slopes of inverse depth per pixel; false where the samples lie on a line.
  bool slopes(double& a, double& b) const {
    const double suu = uu - u * u / n, suv = uv - u * v / n, svv = vv - v * v / n;
    const double sru = ru - r * u / n, srv = rv - r * v / n;
    const double determinant = suu * svv - suv * suv;
    if (!(determinant > 1e-3 * suu * svv) || !(suu * svv > 0)) return false;
    a = (sru * svv - srv * suv) / determinant;
    b = (srv * suu - sru * suv) / determinant;
    return true;
  }
};

constexpr int kWindowRadius = 4, kWindowStride = 2, kMinSamples = 9;

}  // namespace

void normals_from_depth(const float* depth, int width, int height, const Pinhole& camera, float max_relative_step,
                        int stride, float* normals) {
  float* normal = normals;
  for (int v = 0; v < height; v += stride) {
    for (int u = 0; u < width; u += stride, normal += 3) {
      normal[0] = normal[1] = normal[2] = 0.0f;
      const size_t i = static_cast<size_t>(v) * width + u;
      const float z = depth[i];
      if (!(z > 0)) continue;
      PlaneFit fit;
      for (int dv = -kWindowRadius; dv <= kWindowRadius; dv += kWindowStride) {
        if (v + dv < 0 || v + dv >= height) continue;
        for (int du = -kWindowRadius; du <= kWindowRadius; du += kWindowStride) {
          if (u + du < 0 || u + du >= width) continue;
          const float d = depth[i + static_cast<std::ptrdiff_t>(dv) * width + du];
          if (d > 0 && std::fabs(d - z) <= max_relative_step * z) fit.add(du, dv, 1.0 / d);
        }
      }
      double a, b;
      if (fit.n < kMinSamples || !fit.slopes(a, b)) continue;
      // Plane n . X = 1 gives 1/z = n . ray: its slopes per pixel are n_x / fx and n_y / fy.
      const double nx = a * camera.fx, ny = b * camera.fy;
      const double nz = fit.r / fit.n - a * fit.u / fit.n - b * fit.v / fit.n - nx * (u + 0.5 - camera.cx) / camera.fx -
                        ny * (v + 0.5 - camera.cy) / camera.fy;
      const double length = std::sqrt(nx * nx + ny * ny + nz * nz);
      if (!(length > 0)) continue;
      normal[0] = static_cast<float>(nx / length);
      normal[1] = static_cast<float>(ny / length);
      normal[2] = static_cast<float>(nz / length);
    }
  }
}

TrackingLoss tracking_loss(const TrackingLossInput& in, size_t pixels, float* d_rgb, float* d_depth) {
  TrackingLoss out{};
  auto sign = [](float x) { return static_cast<float>((x > 0.0f) - (x < 0.0f)); };
  for (size_t i = 0; i < pixels; ++i) {
    const bool used = in.mask[i] && in.target_depth[i] > 0.0f && in.alpha[i] > in.silhouette_threshold;
    const float keep = used ? 1.0f : 0.0f;
    const float depth_difference = keep * (in.depth[i] - in.target_depth[i]);
    float color_sum = 0.0f;
    for (int c = 0; c < 3; ++c) {
      const float difference = keep * (in.rgb[3 * i + c] - in.target_rgb[3 * i + c]);
      color_sum += std::fabs(difference);
      d_rgb[3 * i + c] = in.color_weight * sign(difference);
    }
    d_depth[i] = in.depth_weight * sign(depth_difference);
    out.color_sum += color_sum;
    out.depth_sum += std::fabs(depth_difference);
    out.count += used;
  }
  return out;
}

}  // namespace vtslam
