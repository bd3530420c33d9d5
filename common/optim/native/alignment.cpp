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

class BandSum {
 public:
  BandSum(const ReferenceView& reference, const ObservedView& observed, int width, int height, const Pinhole& camera,
          const double R[9], const double t[3], const AlignmentOptions& options)
      : reference_(reference), observed_(observed), width_(width), height_(height), camera_(camera), options_(options) {
    for (int i = 0; i < 9; ++i) R_[i] = static_cast<float>(R[i]);
    for (int i = 0; i < 3; ++i) t_[i] = static_cast<float>(t[i]);
  }

  void rows(int begin, int end, NormalEquations& out) const {
    for (int v = begin; v < end; ++v) {
      for (int u = 0; u < width_; ++u) pixel(u, v, out);
    }
  }

 private:
  void pixel(int u, int v, NormalEquations& out) const {
    const size_t i = static_cast<size_t>(v) * width_ + u;
    const float z = reference_.depth[i];
    if (!reference_.mask[i] || !(z > 0.0f)) return;
    const Point local{(u + 0.5f - camera_.cx) / camera_.fx * z, (v + 0.5f - camera_.cy) / camera_.fy * z, z};
    const Point p{R_[0] * local.x + R_[1] * local.y + R_[2] * local.z + t_[0],
                  R_[3] * local.x + R_[4] * local.y + R_[5] * local.z + t_[1],
                  R_[6] * local.x + R_[7] * local.y + R_[8] * local.z + t_[2]};
    if (!(p.z > 0.01f)) return;
    const float image_u = camera_.fx * p.x / p.z + camera_.cx, image_v = camera_.fy * p.y / p.z + camera_.cy;
    const float border = options_.border_px + 0.5f;
    if (!(image_u >= border && image_v >= border && image_u < width_ - border && image_v < height_ - border)) return;
    if (!depth_term(i, p, image_u, image_v, out)) return;
    ++out.visible_count;
    color_term(i, p, image_u, image_v, out);
  }

  // Point-to-plane distance to the nearest observed point. False where the two surfaces do not belong together.
  bool depth_term(size_t i, const Point& p, float image_u, float image_v, NormalEquations& out) const {
    const int u = static_cast<int>(image_u), v = static_cast<int>(image_v);
    const float d = observed_.packed[(static_cast<size_t>(v) * width_ + u) * kPackedChannels + 9];
    if (!(d > 0.0f)) return false;
    const float sigma_z = options_.depth_sigma_base + options_.depth_sigma_quadratic * d * d;
    const float* n = reference_.normals + 3 * i;
    if (n[0] == 0.0f && n[1] == 0.0f && n[2] == 0.0f) {
      return std::fabs(d - p.z) <= options_.depth_gate_sigmas * sigma_z;
    }
    const Point normal{R_[0] * n[0] + R_[1] * n[1] + R_[2] * n[2], R_[3] * n[0] + R_[4] * n[1] + R_[5] * n[2],
                       R_[6] * n[0] + R_[7] * n[1] + R_[8] * n[2]};
    const Point q{(u + 0.5f - camera_.cx) / camera_.fx * d, (v + 0.5f - camera_.cy) / camera_.fy * d, d};
    const float distance = normal.x * (q.x - p.x) + normal.y * (q.y - p.y) + normal.z * (q.z - p.z);
    const float slant = std::fabs(normal.x * q.x + normal.y * q.y + normal.z * q.z) /
                        std::sqrt(q.x * q.x + q.y * q.y + q.z * q.z);
    const float sigma = sigma_z * std::max(slant, 0.2f);
    const float r = distance / sigma;
    if (std::fabs(r) > options_.depth_gate_sigmas) return false;
    float J[6];
    twist_row(p, Point{-normal.x, -normal.y, -normal.z}, J);
    const float scale = options_.depth_weight * huber_weight(r) / (sigma * sigma);
    add_row(out, J, scale, distance);
    out.depth_cost += options_.depth_weight * huber_cost(r);
    ++out.depth_count;
    return true;
  }

  // Colour differences of the three channels share the projection's Jacobian A [2,6]: H += A^T (sum w g g^T) A.
  void color_term(size_t i, const Point& p, float image_u, float image_v, NormalEquations& out) const {
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
    const float iz = 1.0f / p.z, au = camera_.fx * iz, av = camera_.fy * iz;
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
    const int u = std::min(std::max(static_cast<int>(std::floor(x)), 0), width_ - 2);
    const int v = std::min(std::max(static_cast<int>(std::floor(y)), 0), height_ - 2);
    const float a = x - u, b = y - v;
    const float* p = observed_.packed + (static_cast<size_t>(v) * width_ + u) * kPackedChannels;
    const float* q = p + static_cast<size_t>(width_) * kPackedChannels;
    for (int c = 0; c < 9; ++c) {
      const float top = p[c] + a * (p[c + kPackedChannels] - p[c]);
      const float bottom = q[c] + a * (q[c + kPackedChannels] - q[c]);
      out[c] = top + b * (bottom - top);
    }
  }

  ReferenceView reference_;
  ObservedView observed_;
  int width_, height_;
  Pinhole camera_;
  AlignmentOptions options_;
  float R_[9], t_[3];
};

void add(NormalEquations& sum, const NormalEquations& part) {
  for (int i = 0; i < 21; ++i) sum.H[i] += part.H[i];
  for (int i = 0; i < 6; ++i) sum.g[i] += part.g[i];
  sum.color_cost += part.color_cost;
  sum.depth_cost += part.depth_cost;
  sum.color_count += part.color_count;
  sum.depth_count += part.depth_count;
  sum.visible_count += part.visible_count;
}

}  // namespace

NormalEquations normal_equations(const ReferenceView& reference, const ObservedView& observed, int width, int height,
                                 const Pinhole& camera, const double R[9], const double t[3],
                                 const AlignmentOptions& options, int threads) {
  const BandSum sum(reference, observed, width, height, camera, R, t, options);
  std::vector<NormalEquations> bands(kBands, NormalEquations{});
  const int workers = std::min(std::max(threads, 1), kBands);
  auto work = [&](int worker) {
    for (int band = worker; band < kBands; band += workers) {
      sum.rows(height * band / kBands, height * (band + 1) / kBands, bands[band]);
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

void normals_from_depth(const float* depth, int width, int height, const Pinhole& camera, float max_relative_step,
                        float* normals) {
  std::memset(normals, 0, sizeof(float) * 3 * width * static_cast<size_t>(height));
  auto point = [&](int u, int v, float z) {
    return Point{(u + 0.5f - camera.cx) / camera.fx * z, (v + 0.5f - camera.cy) / camera.fy * z, z};
  };
  for (int v = 1; v + 1 < height; ++v) {
    for (int u = 1; u + 1 < width; ++u) {
      const size_t i = static_cast<size_t>(v) * width + u;
      const float z = depth[i], left = depth[i - 1], right = depth[i + 1], up = depth[i - width],
                  down = depth[i + width];
      if (!(z > 0 && left > 0 && right > 0 && up > 0 && down > 0)) continue;
      const float step = std::max(std::max(std::fabs(left - z), std::fabs(right - z)),
                                  std::max(std::fabs(up - z), std::fabs(down - z)));
      if (step > max_relative_step * z) continue;
      const Point a = point(u + 1, v, right), b = point(u - 1, v, left), c = point(u, v + 1, down),
                  d = point(u, v - 1, up);
      const Point s{a.x - b.x, a.y - b.y, a.z - b.z}, r{c.x - d.x, c.y - d.y, c.z - d.z};
      const Point n{r.y * s.z - r.z * s.y, r.z * s.x - r.x * s.z, r.x * s.y - r.y * s.x};
      const float length = std::sqrt(n.x * n.x + n.y * n.y + n.z * n.z);
      if (!(length > 0)) continue;
      normals[3 * i] = n.x / length;
      normals[3 * i + 1] = n.y / length;
      normals[3 * i + 2] = n.z / length;
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
