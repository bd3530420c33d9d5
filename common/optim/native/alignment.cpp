#include "alignment.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <thread>
#include <vector>

namespace vtslam {
namespace {

constexpr int kBands = 16;
constexpr int kPackedChannels = 10;

// Huber: weight and cost of a residual in sigmas.
inline float huber_weight(float r) {
  const float a = std::fabs(r);
  return a <= 1.0f ? 1.0f : 1.0f / a;
}
inline float huber_cost(float r) {
  const float a = std::fabs(r);
  return a <= 1.0f ? 0.5f * a * a : a - 0.5f;
}

struct Point {
  float x, y, z;
};

// Adds w * J J^T and w * r * J for one row J.
inline void add_row(NormalEquations& out, const float J[6], float weight, float residual) {
  int k = 0;
  for (int i = 0; i < 6; ++i) {
    const float wj = weight * J[i];
    for (int j = i; j < 6; ++j) out.H[k++] += static_cast<double>(wj * J[j]);
    out.g[i] += static_cast<double>(wj * residual);
  }
}

// Row of a left twist for a derivative g with respect to the point p: (g, p x g).
inline void twist_row(const Point& p, const Point& g, float J[6]) {
  J[0] = g.x;
  J[1] = g.y;
  J[2] = g.z;
  J[3] = p.y * g.z - p.z * g.y;
  J[4] = p.z * g.x - p.x * g.z;
  J[5] = p.x * g.y - p.y * g.x;
}

struct Motion {
  Motion(const double R_in[9], const double t_in[3]) {
    for (int i = 0; i < 9; ++i) R[i] = static_cast<float>(R_in[i]);
    for (int i = 0; i < 3; ++i) t[i] = static_cast<float>(t_in[i]);
  }
  Point rotated(const Point& p) const {
    return {R[0] * p.x + R[1] * p.y + R[2] * p.z, R[3] * p.x + R[4] * p.y + R[5] * p.z,
            R[6] * p.x + R[7] * p.y + R[8] * p.z};
  }
  Point moved(const Point& p) const {
    const Point q = rotated(p);
    return {q.x + t[0], q.y + t[1], q.z + t[2]};
  }
  float R[9], t[3];
};

inline float dot(const Point& a, const Point& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

inline Point back_projected(float u, float v, float z, const Pinhole& camera) {
  return {(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z};
}

inline float depth_sigma(float z, const AlignmentOptions& options) {
  return options.depth_sigma_base + options.depth_sigma_quadratic * z * z;
}

// Point-to-plane distances between map points and the frame's depth image (nearest pixel).
class DepthTerm {
 public:
  DepthTerm(const ReferencePoints& points, const DepthView& view, const Motion& motion, const AlignmentOptions& options)
      : points_(points), view_(view), motion_(motion), options_(options) {}

  void band(int64_t begin, int64_t end, NormalEquations& out) const {
    for (int64_t i = begin; i < end; ++i) point(points_.packed + 6 * i, out);
  }

 private:
  void point(const float* row, NormalEquations& out) const {
    const Point p = motion_.moved({row[0], row[1], row[2]});
    if (!(p.z > 0.01f)) return;
    const float image_u = view_.camera.fx * p.x / p.z + view_.camera.cx;
    const float image_v = view_.camera.fy * p.y / p.z + view_.camera.cy;
    if (!(image_u >= 0.0f && image_v >= 0.0f && image_u < view_.width && image_v < view_.height)) return;
    const int u = static_cast<int>(image_u), v = static_cast<int>(image_v);
    const float d = view_.depth[static_cast<size_t>(v) * view_.width + u];
    if (!(d > 0.0f)) return;
    const Point normal = motion_.rotated({row[3], row[4], row[5]});
    const Point q = back_projected(u + 0.5f, v + 0.5f, d, view_.camera);
    const float distance = dot(normal, {q.x - p.x, q.y - p.y, q.z - p.z});
    // Noise is along the ray: it shortens with the slant when measured along the normal.
    const float slant = std::fabs(dot(normal, q)) / std::sqrt(dot(q, q));
    const float sigma = depth_sigma(d, options_) * std::max(slant, 0.2f);
    const float r = distance / sigma;
    if (std::fabs(r) > options_.depth_gate_sigmas) return;
    float J[6];
    twist_row(p, Point{-normal.x, -normal.y, -normal.z}, J);
    add_row(out, J, options_.depth_weight * huber_weight(r) / (sigma * sigma), distance);
    out.depth_cost += options_.depth_weight * huber_cost(r);
    ++out.depth_count;
  }

  ReferencePoints points_;
  DepthView view_;
  Motion motion_;
  AlignmentOptions options_;
};

// Colour differences between a rendered view, warped, and one pyramid level of the frame.
class ColorTerm {
 public:
  ColorTerm(const ReferenceView& reference, const ObservedView& observed, const Motion& motion,
            const AlignmentOptions& options)
      : reference_(reference), observed_(observed), motion_(motion), options_(options) {}

  void rows(int begin, int end, NormalEquations& out) const {
    for (int v = begin; v < end; ++v) {
      for (int u = 0; u < observed_.width; ++u) pixel(u, v, out);
    }
  }

 private:
  void pixel(int u, int v, NormalEquations& out) const {
    const Pinhole& camera = observed_.camera;
    const size_t i = static_cast<size_t>(v) * observed_.width + u;
    const float z = reference_.depth[i];
    if (!reference_.mask[i] || !(z > 0.0f)) return;
    const Point p = motion_.moved(back_projected(u + 0.5f, v + 0.5f, z, camera));
    if (!(p.z > 0.01f)) return;
    const float image_u = camera.fx * p.x / p.z + camera.cx, image_v = camera.fy * p.y / p.z + camera.cy;
    const float border = options_.border_px + 0.5f;
    if (!(image_u >= border && image_v >= border && image_u < observed_.width - border &&
          image_v < observed_.height - border)) {
      return;
    }
    const size_t nearest = static_cast<size_t>(image_v) * observed_.width + static_cast<size_t>(image_u);
    const float d = observed_.packed[nearest * kPackedChannels + 9];
    if (!(d > 0.0f && std::fabs(d - p.z) <= options_.depth_gate_sigmas * depth_sigma(d, options_))) return;
    add_difference(i, p, image_u, image_v, out);
  }

  // The three channels share the projection's Jacobian A [2,6]: H += A^T (sum w g g^T) A.
  void add_difference(size_t i, const Point& p, float image_u, float image_v, NormalEquations& out) const {
    float sample[9];
    bilinear(image_u - 0.5f, image_v - 0.5f, sample);
    float uu = 0, uv = 0, vv = 0, ru = 0, rv = 0;
    for (int c = 0; c < 3; ++c) {
      const float difference = sample[c] - reference_.rgb[3 * i + c];
      const float r = difference / options_.color_sigma;
      const float w = huber_weight(r);
      const float gu = sample[3 + c], gv = sample[6 + c];
      uu += w * gu * gu;
      uv += w * gu * gv;
      vv += w * gv * gv;
      ru += w * difference * gu;
      rv += w * difference * gv;
      out.color_cost += options_.color_weight * huber_cost(r);
    }
    ++out.color_count;
    const float scale = options_.color_weight / (options_.color_sigma * options_.color_sigma);
    const float iz = 1.0f / p.z, au = observed_.camera.fx * iz, av = observed_.camera.fy * iz;
    float A[2][6];
    twist_row(p, Point{au, 0.0f, -au * p.x * iz}, A[0]);
    twist_row(p, Point{0.0f, av, -av * p.y * iz}, A[1]);
    int k = 0;
    for (int a = 0; a < 6; ++a) {
      const float left_u = scale * (uu * A[0][a] + uv * A[1][a]), left_v = scale * (uv * A[0][a] + vv * A[1][a]);
      for (int b = a; b < 6; ++b) out.H[k++] += static_cast<double>(left_u * A[0][b] + left_v * A[1][b]);
      out.g[a] += static_cast<double>(scale * (ru * A[0][a] + rv * A[1][a]));
    }
  }

  void bilinear(float x, float y, float out[9]) const {
    const int u = std::min(std::max(static_cast<int>(std::floor(x)), 0), observed_.width - 2);
    const int v = std::min(std::max(static_cast<int>(std::floor(y)), 0), observed_.height - 2);
    const float a = x - u, b = y - v;
    const float* p = observed_.packed + (static_cast<size_t>(v) * observed_.width + u) * kPackedChannels;
    const float* q = p + static_cast<size_t>(observed_.width) * kPackedChannels;
    for (int c = 0; c < 9; ++c) {
      const float top = p[c] + a * (p[c + kPackedChannels] - p[c]);
      const float bottom = q[c] + a * (q[c + kPackedChannels] - q[c]);
      out[c] = top + b * (bottom - top);
    }
  }

  ReferenceView reference_;
  ObservedView observed_;
  Motion motion_;
  AlignmentOptions options_;
};

void add(NormalEquations& sum, const NormalEquations& part) {
  for (int i = 0; i < 21; ++i) sum.H[i] += part.H[i];
  for (int i = 0; i < 6; ++i) sum.g[i] += part.g[i];
  sum.color_cost += part.color_cost;
  sum.depth_cost += part.depth_cost;
  sum.color_count += part.color_count;
  sum.depth_count += part.depth_count;
}

}  // namespace

NormalEquations normal_equations(const ReferenceView& reference, const ObservedView& observed,
                                 const ReferencePoints& points, const DepthView& depth, const double R[9],
                                 const double t[3], const AlignmentOptions& options, int threads) {
  const Motion motion(R, t);
  const ColorTerm color(reference, observed, motion, options);
  const DepthTerm planes(points, depth, motion, options);
  std::vector<NormalEquations> bands(kBands, NormalEquations{});
  const int workers = std::min(std::max(threads, 1), kBands);
  auto work = [&](int worker) {
    for (int band = worker; band < kBands; band += workers) {
      if (options.color_weight > 0) {
        color.rows(observed.height * band / kBands, observed.height * (band + 1) / kBands, bands[band]);
      }
      if (options.depth_weight > 0) {
        planes.band(points.count * band / kBands, points.count * (band + 1) / kBands, bands[band]);
      }
    }
  };
  std::vector<std::thread> pool;
  for (int worker = 1; worker < workers; ++worker) pool.emplace_back(work, worker);
  work(0);
  for (std::thread& thread : pool) thread.join();
  NormalEquations total{};
  for (const NormalEquations& band : bands) add(total, band);
  return total;
}

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
                        float* normals) {
  std::memset(normals, 0, sizeof(float) * 3 * width * static_cast<size_t>(height));
  for (int v = 0; v < height; ++v) {
    for (int u = 0; u < width; ++u) {
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
      normals[3 * i] = static_cast<float>(nx / length);
      normals[3 * i + 1] = static_cast<float>(ny / length);
      normals[3 * i + 2] = static_cast<float>(nz / length);
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
