// Per-Gaussian kernels: projection with tile counts, and the chain rule. Arithmetic that parity depends on is in
// double, in loops over small arrays that the compiler turns into vector code.
#pragma once

#include "kernels_math.hpp"
#include "types.hpp"

namespace vtslam::native {
namespace {

constexpr int kGroup = 16;  // Gaussians handled together

struct Group {
  alignas(64) float sigma[kGroup], opacity_complement[kGroup], log2_opacity[kGroup];
  alignas(64) float x[kGroup], y[kGroup], z[kGroup];
  alignas(64) float column[kGroup], column_fraction[kGroup], row[kGroup], row_fraction[kGroup];
  alignas(64) float conic_xx[kGroup], conic_xy[kGroup], conic_yy[kGroup];
  alignas(64) int left[kGroup], right[kGroup], top[kGroup], bottom[kGroup];
};

VTSLAM_INLINE bool all_finite(const float* values, size_t count) {
  uint32_t bad = 0;
  for (size_t i = 0; i < count; ++i) {
    const uint32_t exponent = __builtin_bit_cast(uint32_t, values[i]) & 0x7F800000u;
    bad |= uint32_t(exponent == 0x7F800000u);
  }
  return bad == 0;
}

VTSLAM_INLINE bool radii_in_range(const float* log_radii, size_t count) {
  uint32_t bad = 0;
  for (size_t i = 0; i < count; ++i) bad |= uint32_t(!(__builtin_fabsf(log_radii[i]) <= kMaxLogRadius));
  return bad == 0;
}

// floor and ceil of a value in [-1, 2^15], in a form that every instruction set vectorises.
VTSLAM_INLINE int floor_of(double a) { return int(a + 65536.0) - 65536; }
VTSLAM_INLINE int ceil_of(double a) { return 65536 - int(65536.0 - a); }
VTSLAM_INLINE double clamped(double a, double low, double high) {
  a = a < low ? low : a;
  return a > high ? high : a;
}

// sigma = exp(log radius), opacity = logistic(logit), its complement and its logarithm.
VTSLAM_INLINE void activate(const float* log_radii, const float* logits, Group& group) {
  for (int i = 0; i < kGroup; i += kLanes) {
    store(group.sigma + i, exp_of(load(log_radii + i)));
    const Vec logit = load(logits + i), zero = splat(0.0f), one = splat(1.0f);
    const Vec e = exp_of(zero - absolute(logit));
    const Vec complement = select(at_least(logit, zero), e, one) / (one + e);
    const Vec log2_opacity = minimum(logit, zero) * splat(kLog2E) - log2_of(one + e);
    store(group.opacity_complement + i, complement);
    store(group.log2_opacity + i, log2_opacity);
  }
}

VTSLAM_INLINE void project_group(const View& view, const Settings& settings, const float* means, Group& group) {
  const double* r = view.rotation;
  const double* t = view.translation;
  const double low_pass = settings.low_pass, log2_alpha_min = log2_scalar(settings.alpha_min);
  for (int l = 0; l < kGroup; ++l) {
    const double mx = means[3 * l], my = means[3 * l + 1], mz = means[3 * l + 2];
    const double x = r[0] * mx + r[1] * my + r[2] * mz + t[0];
    const double y = r[3] * mx + r[4] * my + r[5] * mz + t[1];
    const double z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
    const bool in_front = z > double(settings.near_m);
    const double inverse_z = 1.0 / (in_front ? z : 1.0);
    const double xn = x * inverse_z, yn = y * inverse_z;
    const double u = view.fx * xn + view.cx, v = view.fy * yn + view.cy;
    const double sigma = group.sigma[l], k = sigma * sigma * inverse_z * inverse_z;
    const double qa = k * view.fx * view.fx, qb = k * view.fx * view.fy, qc = k * view.fy * view.fy;
    const double a0 = qa * (1.0 + xn * xn), b = qb * xn * yn, c0 = qc * (1.0 + yn * yn);
    const double a = a0 + low_pass, c = c0 + low_pass;
    // a c - b^2 without the cancellation.
    const double det = qa * qc * (1.0 + xn * xn + yn * yn) + low_pass * (a0 + c0 + low_pass);
    const double scale = double(kLog2E) / det;
    const double reach2 = 2.0 * double(kLn2) * (double(group.log2_opacity[l]) - log2_alpha_min);
    const bool visible =
        in_front && reach2 >= 0.0 && __builtin_fabs(u) < kMaxImageCoordinate && __builtin_fabs(v) < kMaxImageCoordinate;
    // A little more than where alpha_min is met, for rounding; the pixel loops test alpha itself.
    const double reach_u = double(__builtin_sqrtf(visible ? float(reach2 * a) : 0.0f)) * 1.00001 + 1e-3;
    const double reach_v = double(__builtin_sqrtf(visible ? float(reach2 * c) : 0.0f)) * 1.00001 + 1e-3;
    const double left = clamped(u - reach_u - 0.5, -1.0, view.width);
    const double right = clamped(u + reach_u - 0.5, -1.0, view.width - 1.0);
    const double top = clamped(v - reach_v - 0.5, -1.0, view.height);
    const double bottom = clamped(v + reach_v - 0.5, -1.0, view.height - 1.0);
    group.x[l] = float(x);
    group.y[l] = float(y);
    group.z[l] = float(z);
    const float column = float(floor_of(clamped(u, -65000.0, 65000.0)));
    const float row = float(floor_of(clamped(v, -65000.0, 65000.0)));
    group.column[l] = column;
    group.row[l] = row;
    group.column_fraction[l] = float(u - double(column));
    group.row_fraction[l] = float(v - double(row));
    group.conic_xx[l] = float(-0.5 * c * scale);
    group.conic_xy[l] = float(b * scale);
    group.conic_yy[l] = float(-0.5 * a * scale);
    const int first_column = ceil_of(left), first_row = ceil_of(top);
    group.left[l] = first_column > 0 ? first_column : 0;
    group.right[l] = visible ? floor_of(right) : -1;
    group.top[l] = first_row > 0 ? first_row : 0;
    group.bottom[l] = floor_of(bottom);
  }
}

VTSLAM_INLINE void write_record(const Group& group, int l, const float* color, SplatRecord& record) {
  record.column = group.column[l];
  record.column_fraction = group.column_fraction[l];
  record.row = group.row[l];
  record.row_fraction = group.row_fraction[l];
  record.conic_xx = group.conic_xx[l];
  record.conic_xy = group.conic_xy[l];
  record.conic_yy = group.conic_yy[l];
  record.log2_opacity = group.log2_opacity[l];
  record.red = color[0];
  record.green = color[1];
  record.blue = color[2];
  record.depth = group.z[l];
  record.left = int16_t(group.left[l]);
  record.right = int16_t(group.right[l]);
  record.top = int16_t(group.top[l]);
  record.bottom = int16_t(group.bottom[l]);
}

VTSLAM_INLINE void keep_geometry(const Group& group, uint32_t first, int count, const Geometry& geometry) {
  for (int l = 0; l < count; ++l) geometry.x[first + l] = group.x[l];
  for (int l = 0; l < count; ++l) geometry.y[first + l] = group.y[l];
  for (int l = 0; l < count; ++l) geometry.z[first + l] = group.z[l];
  for (int l = 0; l < count; ++l) geometry.sigma[first + l] = group.sigma[l];
  for (int l = 0; l < count; ++l) geometry.opacity_complement[first + l] = group.opacity_complement[l];
}

// Whether all inputs of a group are finite and in range.
VTSLAM_INLINE bool valid_group(const float* means, const float* colors, const float* log_radii, const float* logits) {
  return all_finite(means, 3 * kGroup) & all_finite(colors, 3 * kGroup) & all_finite(logits, kGroup) &
         radii_in_range(log_radii, kGroup);
}

bool project(const ProjectArgs& args, uint32_t begin, uint32_t end, uint32_t* tile_counts, uint64_t* pairs) {
  const SplatInputs& in = args.inputs;
  Group group;
  float padded[8 * kGroup];  // the last group, filled up
  uint64_t slots = 0;
  bool valid = true;
  for (uint32_t first = begin; first < end; first += kGroup) {
    const int count = end - first < kGroup ? int(end - first) : kGroup;
    const float *means = in.means + 3 * size_t(first), *colors = in.colors + 3 * size_t(first);
    const float *log_radii = in.log_radii + first, *logits = in.opacity_logits + first;
    if (count < kGroup) {
      for (float& value : padded) value = 0.0f;
      for (int i = 0; i < 3 * count; ++i) padded[i] = means[i];
      for (int i = 0; i < 3 * count; ++i) padded[3 * kGroup + i] = colors[i];
      for (int i = 0; i < count; ++i) padded[6 * kGroup + i] = log_radii[i];
      for (int i = 0; i < count; ++i) padded[7 * kGroup + i] = logits[i];
      means = padded;
      colors = padded + 3 * kGroup;
      log_radii = padded + 6 * kGroup;
      logits = padded + 7 * kGroup;
    }
    valid &= valid_group(means, colors, log_radii, logits);
    if (!valid) break;
    activate(log_radii, logits, group);
    project_group(args.view, args.settings, means, group);
    keep_geometry(group, first, count, args.geometry);
    for (int l = 0; l < count; ++l) {
      const uint32_t i = first + l;
      args.slot_starts[i] = uint32_t(slots);
      TileRect rect{1, 0, 1, 0};
      if (group.left[l] <= group.right[l] && group.top[l] <= group.bottom[l]) {
        rect = {uint16_t(group.left[l] / kTile), uint16_t(group.right[l] / kTile), uint16_t(group.top[l] / kTile),
                uint16_t(group.bottom[l] / kTile)};
        SplatRecord& record = args.records[i];
        write_record(group, l, colors + 3 * l, record);
        record.slot_stride = rect.right - rect.left + 1u;
        record.slot_base = uint32_t(slots) - rect.top * record.slot_stride - rect.left;
        slots += uint64_t(record.slot_stride) * (rect.bottom - rect.top + 1u);
        for (int y = rect.top; y <= rect.bottom; ++y)
          for (int x = rect.left; x <= rect.right; ++x) ++tile_counts[y * args.view.tiles_x + x];
      }
      args.rects[i] = rect;
    }
  }
  *pairs = slots;
  return valid;
}

// Sums of one Gaussian over its tiles, in the order of kSum*; the order of addition is that of the tiles.
template <bool geometry>
VTSLAM_INLINE void add_slots(const float* slots, uint32_t count, float* sums) {
  constexpr int size = slot_floats(geometry);
  for (int i = 0; i < size; ++i) sums[i] = 0.0f;
  for (uint32_t s = 0; s < count; ++s)
    for (int i = 0; i < size; ++i) sums[i] += slots[size_t(s) * size + i];
}

// The sum kSum* among those that add_slots found.
template <bool geometry>
VTSLAM_INLINE float sum_of(const float* sums, int which) {
  return sums[slot_lane<geometry ? kAllSums : kFewSums>(which)];
}

struct ChainGroup {
  alignas(64) float sums[kGroup][slot_floats(true)];
  alignas(64) float conic_xx[kGroup], conic_xy[kGroup], conic_yy[kGroup];
  alignas(64) float x[kGroup], y[kGroup], z[kGroup], sigma[kGroup];
  alignas(64) float d_log_radius[kGroup];
  alignas(64) double d_point[3][kGroup], pose[6][kGroup];
};

// Derivatives by log radius and camera point from the sums over pixels. With K the conic, M the second moments and
// m the first ones: dL/d(mean) = K m, dL/d(covariance) = K M K / 2; then through the projection and its Jacobian.
template <bool geometry>
VTSLAM_INLINE void chain_group(const View& view, ChainGroup& g) {
  for (int l = 0; l < kGroup; ++l) {
    const float* s = g.sums[l];
    const double mxx = sum_of<geometry>(s, kSumXX), mxy = sum_of<geometry>(s, kSumXY),
                 myy = sum_of<geometry>(s, kSumYY);
    const double ka = double(g.conic_xx[l]) * (-2.0 * kLn2), kb = double(g.conic_xy[l]) * double(-kLn2);
    const double kc = double(g.conic_yy[l]) * (-2.0 * kLn2);
    const double p00 = ka * mxx + kb * mxy, p01 = ka * mxy + kb * myy;
    const double p10 = kb * mxx + kc * mxy, p11 = kb * mxy + kc * myy;
    const double d_a = 0.5 * (p00 * ka + p01 * kb), d_b = p00 * kb + p01 * kc, d_c = 0.5 * (p10 * kb + p11 * kc);
    const double inverse_z = 1.0 / double(g.z[l]), xn = g.x[l] * inverse_z, yn = g.y[l] * inverse_z;
    const double k = double(g.sigma[l]) * double(g.sigma[l]) * inverse_z * inverse_z;
    const double qa = k * view.fx * view.fx, qb = k * view.fx * view.fy, qc = k * view.fy * view.fy;
    const double by_scale = 2.0 * (d_a * qa * (1.0 + xn * xn) + d_b * qb * xn * yn + d_c * qc * (1.0 + yn * yn));
    g.d_log_radius[l] = float(by_scale);
    if (!geometry) continue;
    const double mx = sum_of<geometry>(s, kSumX), my = sum_of<geometry>(s, kSumY);
    const double d_u = ka * mx + kb * my, d_v = kb * mx + kc * my;
    const double d_xn = view.fx * d_u + 2.0 * d_a * qa * xn + d_b * qb * yn;
    const double d_yn = view.fy * d_v + 2.0 * d_c * qc * yn + d_b * qb * xn;
    const double gx = d_xn * inverse_z, gy = d_yn * inverse_z;
    const double gz = double(sum_of<geometry>(s, kSumDepth)) - (d_xn * xn + d_yn * yn + by_scale) * inverse_z;
    g.d_point[0][l] = gx;
    g.d_point[1][l] = gy;
    g.d_point[2][l] = gz;
    g.pose[0][l] += gx;
    g.pose[1][l] += gy;
    g.pose[2][l] += gz;
    g.pose[3][l] += g.y[l] * gz - g.z[l] * gy;
    g.pose[4][l] += g.z[l] * gx - g.x[l] * gz;
    g.pose[5][l] += g.x[l] * gy - g.y[l] * gx;
  }
}

// Sums over tiles and what the chain rule needs of Gaussian i, or if it has no pixel a harmless stand-in with zero
// sums, so that the arithmetic stays finite.
template <bool geometry>
VTSLAM_INLINE void gather(const ChainArgs& args, uint32_t i, bool present, ChainGroup& g, int l) {
  if (present) {
    const SplatRecord& record = args.records[i];
    const TileRect rect = args.rects[i];
    const uint32_t slots = uint32_t(rect.right - rect.left + 1) * uint32_t(rect.bottom - rect.top + 1);
    const size_t start = size_t(args.chunk_bases[i >> args.chunk_shift]) + args.slot_starts[i];
    add_slots<geometry>(args.slots + start * slot_floats(geometry), slots, g.sums[l]);
    g.conic_xx[l] = record.conic_xx;
    g.conic_xy[l] = record.conic_xy;
    g.conic_yy[l] = record.conic_yy;
    g.x[l] = args.geometry.x[i];
    g.y[l] = args.geometry.y[i];
    g.z[l] = args.geometry.z[i];
    g.sigma[l] = args.geometry.sigma[i];
  } else {
    add_slots<geometry>(args.slots, 0, g.sums[l]);
    g.conic_xx[l] = g.conic_xy[l] = g.conic_yy[l] = g.x[l] = g.y[l] = g.sigma[l] = 0.0f;
    g.z[l] = 1.0f;
  }
}

template <bool geometry>
VTSLAM_INLINE void write_gradients(const ChainArgs& args, const ChainGroup& g, int l, uint32_t i) {
  if (args.d_colors != nullptr) {
    const float* s = g.sums[l];
    args.d_colors[3 * size_t(i)] = sum_of<geometry>(s, kSumRed);
    args.d_colors[3 * size_t(i) + 1] = sum_of<geometry>(s, kSumGreen);
    args.d_colors[3 * size_t(i) + 2] = sum_of<geometry>(s, kSumBlue);
    args.d_opacity_logits[i] = sum_of<geometry>(s, kSumAlpha) * args.geometry.opacity_complement[i];
    args.d_log_radii[i] = g.d_log_radius[l];
    if (args.weights != nullptr) args.weights[i] = sum_of<geometry>(s, kSumWeight);
  }
  if (args.d_means == nullptr) return;
  const double* r = args.view.rotation;
  const double gx = g.d_point[0][l], gy = g.d_point[1][l], gz = g.d_point[2][l];
  for (int axis = 0; axis < 3; ++axis)
    args.d_means[3 * size_t(i) + axis] = float(r[axis] * gx + r[3 + axis] * gy + r[6 + axis] * gz);
}

template <bool geometry>
VTSLAM_INLINE void chain_range(const ChainArgs& args, uint32_t begin, uint32_t end, double* pose) {
  ChainGroup g = {};
  for (uint32_t first = begin; first < end; first += kGroup) {
    const int count = end - first < kGroup ? int(end - first) : kGroup;
    for (int l = 0; l < kGroup; ++l)
      gather<geometry>(args, first + l, l < count && args.rects[first + l].left <= args.rects[first + l].right, g, l);
    chain_group<geometry>(args.view, g);
    for (int l = 0; l < count; ++l) write_gradients<geometry>(args, g, l, first + l);
  }
  for (int i = 0; i < 6; ++i)
    for (int l = 0; l < kGroup; ++l) pose[i] += g.pose[i][l];
}

void chain(const ChainArgs& args, uint32_t begin, uint32_t end, double* pose) {
  if (args.want_geometry)
    chain_range<true>(args, begin, end, pose);
  else
    chain_range<false>(args, begin, end, pose);
}

}  // namespace
}  // namespace vtslam::native
