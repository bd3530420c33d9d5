#include <algorithm>
#include <cmath>
#include <cstring>
#include <thread>
#include <vector>

#include "alignment.hpp"
#include "motion.hpp"

// One version per instruction set, chosen when the library is loaded.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && defined(__linux__)
#define VTSLAM_CLONES __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define VTSLAM_CLONES
#endif
#define VTSLAM_INLINE inline __attribute__((always_inline))

namespace vtslam {
namespace {

constexpr int kBands = 16;
constexpr int kPackedChannels = 10, kSampled = 9;
constexpr int kLanes = 16, kBatch = 64;
constexpr int kBatchesInFloat = 32;       // sums of so many batches stay in float
constexpr float kNearest = 0.01f;         // metres
constexpr int64_t kWorthThreads = 20000;  // measurements; fewer take less time than a thread takes to start

// Huber: weight and cost of a residual in sigmas.
VTSLAM_INLINE float huber_weight(float r) { return 1.0f / std::max(std::fabs(r), 1.0f); }
VTSLAM_INLINE float huber_cost(float r) {
  const float a = std::fabs(r), squared = std::min(a, 1.0f);
  return squared * (a - 0.5f * squared);
}

VTSLAM_INLINE float depth_sigma(float z, const AlignmentOptions& options) {
  return options.depth_sigma_base + options.depth_sigma_quadratic * z * z;
}

using Lane = float[kBatch];

// Sums in lanes: H's upper triangle, g and a cost. Each lane sums its own points, so the order of addition is fixed.
class Sums {
 public:
  // Adds w J J^T and w r J for a batch of rows J.
  VTSLAM_INLINE void add_rows(const Lane (&J)[6], const Lane& weight, const Lane& residual, const Lane& cost) {
    for (int first = 0; first < kBatch; first += kLanes) {
      int k = 0;
      for (int i = 0; i < 6; ++i) {
        alignas(64) float weighted[kLanes];
        for (int l = 0; l < kLanes; ++l) weighted[l] = weight[first + l] * J[i][first + l];
        for (int j = i; j < 6; ++j, ++k)
          for (int l = 0; l < kLanes; ++l) H_[k][l] += weighted[l] * J[j][first + l];
        for (int l = 0; l < kLanes; ++l) g_[i][l] += weighted[l] * residual[first + l];
      }
      for (int l = 0; l < kLanes; ++l) cost_[l] += cost[first + l];
    }
    if (++batches_ == kBatchesInFloat) flush();
  }

  // Adds A^T S A and A^T s, where the rows A of the projection share S (uu, uv, vv) and s (ru, rv).
  VTSLAM_INLINE void add_pairs(const Lane (&u)[6], const Lane (&v)[6], const Lane (&S)[3], const Lane (&s)[2],
                               const Lane& cost) {
    for (int first = 0; first < kBatch; first += kLanes) {
      int k = 0;
      for (int i = 0; i < 6; ++i) {
        alignas(64) float by_u[kLanes], by_v[kLanes];
        for (int l = 0; l < kLanes; ++l) {
          const int at = first + l;
          by_u[l] = S[0][at] * u[i][at] + S[1][at] * v[i][at];
          by_v[l] = S[1][at] * u[i][at] + S[2][at] * v[i][at];
        }
        for (int j = i; j < 6; ++j, ++k)
          for (int l = 0; l < kLanes; ++l) H_[k][l] += by_u[l] * u[j][first + l] + by_v[l] * v[j][first + l];
        for (int l = 0; l < kLanes; ++l)
          g_[i][l] += s[0][first + l] * u[i][first + l] + s[1][first + l] * v[i][first + l];
      }
      for (int l = 0; l < kLanes; ++l) cost_[l] += cost[first + l];
    }
    if (++batches_ == kBatchesInFloat) flush();
  }

  // The sums so far go to `out`, the cost to `cost`.
  VTSLAM_INLINE void finish(NormalEquations& out, double& cost) {
    flush();
    for (int k = 0; k < 21; ++k) out.H[k] += H_total_[k];
    for (int i = 0; i < 6; ++i) out.g[i] += g_total_[i];
    cost += cost_total_;
  }

 private:
  VTSLAM_INLINE static void drain(float (&lanes)[kLanes], double& total) {
    for (float& lane : lanes) {
      total += static_cast<double>(lane);
      lane = 0.0f;
    }
  }

  VTSLAM_INLINE void flush() {
    for (int k = 0; k < 21; ++k) drain(H_[k], H_total_[k]);
    for (int i = 0; i < 6; ++i) drain(g_[i], g_total_[i]);
    drain(cost_, cost_total_);
    batches_ = 0;
  }

  alignas(64) float H_[21][kLanes] = {}, g_[6][kLanes] = {}, cost_[kLanes] = {};
  double H_total_[21] = {}, g_total_[6] = {}, cost_total_ = 0;
  int batches_ = 0;
};

// Rows of a left twist for derivatives (gx, gy, gz) with respect to the point p: (g, p x g).
VTSLAM_INLINE void twist_rows(Lane (&J)[6], int l, const Point& p, const Point& g) {
  J[0][l] = g.x;
  J[1][l] = g.y;
  J[2][l] = g.z;
  J[3][l] = p.y * g.z - p.z * g.y;
  J[4][l] = p.z * g.x - p.x * g.z;
  J[5][l] = p.x * g.y - p.y * g.x;
}

// Point-to-plane distances between map points begin to end and the frame's depth image (nearest pixel).
VTSLAM_CLONES void depth_band(const ReferencePoints& points, const DepthView& view, const Motion& motion,
                              const AlignmentOptions& options, int64_t begin, int64_t end, NormalEquations& out) {
  Sums sums;
  alignas(64) Lane J[6], weight, residual, cost, measured, counted;
  alignas(64) Lane px, py, pz, nx, ny, nz;
  alignas(64) int column[kBatch], row[kBatch];
  alignas(64) Lane in[6] = {};
  const Pinhole camera = view.camera;  // copies: what is read under a condition is not vectorised
  const float gate = options.depth_gate_sigmas, depth_weight = options.depth_weight;
  const float width = view.width, height = view.height;
  for (int64_t first = begin; first < end; first += kBatch) {
    const int count = static_cast<int>(std::min<int64_t>(kBatch, end - first));
    const float* packed = points.packed + 6 * first;
    for (int l = 0; l < count; ++l)
      for (int i = 0; i < 6; ++i) in[i][l] = packed[6 * l + i];
    for (int l = 0; l < kBatch; ++l) {
      const Point p = motion.moved({in[0][l], in[1][l], in[2][l]});
      const Point normal = motion.rotated({in[3][l], in[4][l], in[5][l]});
      const bool in_front = (l < count) & (p.z > kNearest);
      const float inverse_z = 1.0f / (in_front ? p.z : 1.0f);
      const float u = camera.fx * p.x * inverse_z + camera.cx;
      const float v = camera.fy * p.y * inverse_z + camera.cy;
      const bool inside = in_front & (u >= 0.0f) & (v >= 0.0f) & (u < width) & (v < height);
      px[l] = p.x, py[l] = p.y, pz[l] = p.z;
      nx[l] = normal.x, ny[l] = normal.y, nz[l] = normal.z;
      column[l] = inside ? static_cast<int>(u) : 0;
      row[l] = inside ? static_cast<int>(v) : 0;
      counted[l] = inside ? 1.0f : 0.0f;
    }
    for (int l = 0; l < kBatch; ++l) measured[l] = counted[l] * view.depth[row[l] * view.width + column[l]];
    for (int l = 0; l < kBatch; ++l) {
      const Point p{px[l], py[l], pz[l]}, normal{nx[l], ny[l], nz[l]};
      const float d = measured[l];
      const Point q = back_projected(column[l] + 0.5f, row[l] + 0.5f, d > 0.0f ? d : 1.0f, camera);
      const float distance = dot(normal, {q.x - p.x, q.y - p.y, q.z - p.z});
      // Noise is along the ray: it shortens with the slant when measured along the normal.
      const float slant = std::fabs(dot(normal, q)) / std::sqrt(dot(q, q));
      const float sigma = depth_sigma(d, options) * std::max(slant, 0.2f);
      const float r = distance / sigma;
      const bool used = (d > 0.0f) & (std::fabs(r) <= gate);
      twist_rows(J, l, p, Point{-normal.x, -normal.y, -normal.z});
      residual[l] = used ? distance : 0.0f;
      weight[l] = used ? depth_weight * huber_weight(r) / (sigma * sigma) : 0.0f;
      cost[l] = used ? depth_weight * huber_cost(r) : 0.0f;
      counted[l] = used ? 1.0f : 0.0f;
    }
    for (int l = 0; l < kBatch; ++l) out.depth_count += counted[l] > 0.0f;
    sums.add_rows(J, weight, residual, cost);
  }
  sums.finish(out, out.depth_cost);
}

using Eight = float __attribute__((vector_size(32)));

// Colour and its two derivatives at (x, y), pixel centres at whole numbers, between four pixels.
VTSLAM_INLINE void bilinear(const ObservedView& observed, float x, float y, float* out) {
  const int u = std::min(static_cast<int>(x), observed.width - 2);
  const int v = std::min(static_cast<int>(y), observed.height - 2);
  const float a = x - u, b = y - v;
  const float* p = observed.packed + (static_cast<size_t>(v) * observed.width + u) * kPackedChannels;
  const float* q = p + static_cast<size_t>(observed.width) * kPackedChannels;
  Eight p0, p1, q0, q1;
  std::memcpy(&p0, p, sizeof p0);
  std::memcpy(&p1, p + kPackedChannels, sizeof p1);
  std::memcpy(&q0, q, sizeof q0);
  std::memcpy(&q1, q + kPackedChannels, sizeof q1);
  const Eight top = p0 + a * (p1 - p0), bottom = q0 + a * (q1 - q0), sampled = top + b * (bottom - top);
  std::memcpy(out, &sampled, sizeof sampled);
  constexpr int last = kSampled - 1;
  const float last_top = p[last] + a * (p[last + kPackedChannels] - p[last]);
  const float last_bottom = q[last] + a * (q[last + kPackedChannels] - q[last]);
  out[last] = last_top + b * (last_bottom - last_top);
}

// Pixels of the rendered view whose place in the frame is known, gathered until a batch is full.
struct ColorBatch {
  alignas(64) Lane x, y, z;
  alignas(64) float sampled[kSampled][kBatch], rendered[3][kBatch];
  int count = 0;
};

VTSLAM_INLINE void add_colors(ColorBatch& batch, const Pinhole& camera, const AlignmentOptions& options, Sums& sums) {
  alignas(64) Lane u[6], v[6], S[3], s[2], cost;
  const float inverse_sigma = 1.0f / options.color_sigma;
  const float scale = options.color_weight * inverse_sigma * inverse_sigma;
  for (int l = 0; l < kBatch; ++l) {
    const bool used = l < batch.count;
    float uu = 0, uv = 0, vv = 0, ru = 0, rv = 0, total = 0;
    for (int c = 0; c < 3; ++c) {
      const float difference = batch.sampled[c][l] - batch.rendered[c][l], r = difference * inverse_sigma;
      const float w = huber_weight(r), gu = batch.sampled[3 + c][l], gv = batch.sampled[6 + c][l];
      uu += w * gu * gu;
      uv += w * gu * gv;
      vv += w * gv * gv;
      ru += w * difference * gu;
      rv += w * difference * gv;
      total += huber_cost(r);
    }
    const float keep = used ? scale : 0.0f;
    S[0][l] = keep * uu, S[1][l] = keep * uv, S[2][l] = keep * vv;
    s[0][l] = keep * ru, s[1][l] = keep * rv;
    cost[l] = used ? options.color_weight * total : 0.0f;
    const Point p{batch.x[l], batch.y[l], batch.z[l]};
    const float iz = 1.0f / (used ? p.z : 1.0f), au = camera.fx * iz, av = camera.fy * iz;
    twist_rows(u, l, p, Point{au, 0.0f, -au * p.x * iz});
    twist_rows(v, l, p, Point{0.0f, av, -av * p.y * iz});
  }
  sums.add_pairs(u, v, S, s, cost);
  batch.count = 0;
}

// Up to a batch of neighbouring pixels of the rendered view, warped into the frame.
struct WarpedRow {
  alignas(64) Lane x, y, z, u, v;  // the point in the frame's camera, and its place in the frame
  alignas(64) int nearest[kBatch], used[kBatch];
};

// Warps `count` pixels from (column, row) on, and marks those that the frame sees at the same place.
VTSLAM_INLINE void warp_row(const ReferenceView& reference, const ObservedView& observed, const Motion& motion,
                            const AlignmentOptions& options, int column, int row, int count, WarpedRow& out) {
  const Pinhole& camera = observed.camera;
  const float border = options.border_px + 0.5f;
  const float right = observed.width - border, bottom = observed.height - border;
  const size_t first = static_cast<size_t>(row) * observed.width + column;
  alignas(64) Lane depth = {};
  for (int l = 0; l < count; ++l) depth[l] = reference.mask[first + l] ? reference.depth[first + l] : 0.0f;
  for (int l = 0; l < kBatch; ++l) {
    const float z = depth[l];
    const Point p = motion.moved(back_projected(column + l + 0.5f, row + 0.5f, z, camera));
    const bool in_front = (z > 0.0f) & (p.z > kNearest);
    const float inverse_z = 1.0f / (in_front ? p.z : 1.0f);
    const float u = camera.fx * p.x * inverse_z + camera.cx, v = camera.fy * p.y * inverse_z + camera.cy;
    const bool inside = in_front & (u >= border) & (v >= border) & (u < right) & (v < bottom);
    out.x[l] = p.x, out.y[l] = p.y, out.z[l] = p.z;
    out.u[l] = u, out.v[l] = v;
    out.nearest[l] = inside ? static_cast<int>(v) * observed.width + static_cast<int>(u) : 0;
    out.used[l] = inside;
  }
  for (int l = 0; l < kBatch; ++l) {
    const float d = observed.packed[static_cast<size_t>(out.nearest[l]) * kPackedChannels + kSampled];
    const float gate = options.depth_gate_sigmas * depth_sigma(d, options);
    out.used[l] &= (d > 0.0f) & (std::fabs(d - out.z[l]) <= gate);
  }
}

// Colour differences between rows begin to end of a rendered view, warped, and one pyramid level of the frame.
VTSLAM_CLONES void color_band(const ReferenceView& reference, const ObservedView& observed, const Motion& motion,
                              const AlignmentOptions& options, int begin, int end, NormalEquations& out) {
  Sums sums;
  ColorBatch batch = {};
  WarpedRow warped;
  int chosen[kBatch];
  for (int v = begin; v < end; ++v) {
    for (int first = 0; first < observed.width; first += kBatch) {
      warp_row(reference, observed, motion, options, first, v, std::min(kBatch, observed.width - first), warped);
      int found = 0;
      for (int l = 0; l < kBatch; ++l) {
        chosen[found] = l;
        found += warped.used[l];
      }
      out.color_count += found;
      for (int k = 0; k < found; ++k) {
        const int from = chosen[k], to = batch.count++;
        const float* rendered = reference.rgb + 3 * (static_cast<size_t>(v) * observed.width + first + from);
        float sample[kSampled];
        bilinear(observed, warped.u[from] - 0.5f, warped.v[from] - 0.5f, sample);
        for (int c = 0; c < kSampled; ++c) batch.sampled[c][to] = sample[c];
        for (int c = 0; c < 3; ++c) batch.rendered[c][to] = rendered[c];
        batch.x[to] = warped.x[from], batch.y[to] = warped.y[from], batch.z[to] = warped.z[from];
        if (batch.count == kBatch) add_colors(batch, observed.camera, options, sums);
      }
    }
  }
  if (batch.count > 0) add_colors(batch, observed.camera, options, sums);
  sums.finish(out, out.color_cost);
}

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
  std::vector<NormalEquations> bands(kBands, NormalEquations{});
  const int64_t measurements = int64_t{observed.width} * observed.height + points.count;
  const int workers = measurements < kWorthThreads ? 1 : std::min(std::max(threads, 1), kBands);
  auto work = [&](int worker) {
    for (int band = worker; band < kBands; band += workers) {
      if (options.color_weight > 0) {
        color_band(reference, observed, motion, options, observed.height * band / kBands,
                   observed.height * (band + 1) / kBands, bands[band]);
      }
      if (options.depth_weight > 0) {
        depth_band(points, depth, motion, options, points.count * band / kBands, points.count * (band + 1) / kBands,
                   bands[band]);
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

}  // namespace vtslam
