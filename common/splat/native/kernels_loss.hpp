// Kernels of the fused mapping loss and of the optimiser step. Image rows are taken as 3 W interleaved floats: a
// horizontal filter then has taps 3 floats apart, and all channels are filtered at once.
#pragma once

#include "kernels_math.hpp"
#include "types.hpp"

namespace vtslam::native {
namespace {

constexpr int kTaps = 2 * kSsimRadius + 1;
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
// exp(-d^2 / (2 1.5^2)), d = -5..5, normalised.
constexpr float kWindow[kTaps] = {0.00102838008f, 0.00759875814f, 0.0360007721f, 0.109360689f,
                                  0.213005537f,   0.266011724f,   0.213005537f,  0.109360689f,
                                  0.0360007721f,  0.00759875814f, 0.00102838008f};

VTSLAM_INLINE Vec load_up_to(const float* p, int n) { return n >= kLanes ? load(p) : load_first(p, n); }
VTSLAM_INLINE void store_up_to(float* p, Vec a, int n) {
  if (n >= kLanes)
    store(p, a);
  else
    store_first(p, a, n);
}

constexpr float kLeastDepth = 1.17549435e-38f;  // zero means that there is none

struct RowSpan {
  int first, last;  // rows of the window inside the image, as taps
};

VTSLAM_INLINE RowSpan window_rows(int row, int height) {
  const int first = row < kSsimRadius ? kSsimRadius - row : 0;
  const int below = height - 1 - row;
  return {first, below < kSsimRadius ? kSsimRadius + below : kTaps - 1};
}

// A row buffer's padding reads as zero: pixels beyond the border count as black, as in the usual SSIM.
VTSLAM_INLINE void clear_padding(float* buffer, int width) {
  const size_t used = size_t(3) * width;
  for (int i = 0; i < kSsimPad; ++i) buffer[i] = 0.0f;
  for (size_t i = kSsimPad + used; i < loss_row_floats(width); ++i) buffer[i] = 0.0f;
}

VTSLAM_INLINE Vec filtered(const float* buffer, int i) {
  Vec total = load(buffer + i + kSsimPad) * splat(kWindow[kSsimRadius]);
  for (int k = 1; k <= kSsimRadius; ++k)
    total = fma(load(buffer + i + kSsimPad - 3 * k) + load(buffer + i + kSsimPad + 3 * k),
                splat(kWindow[kSsimRadius + k]), total);
  return total;
}

// Vertical window over both images: means, means of squares and of products, unfinished (not yet horizontal).
VTSLAM_INLINE void vertical_moments(const LossArgs& args, int row, float* scratch) {
  const int n = 3 * args.width;
  const size_t stride = loss_row_floats(args.width);
  const RowSpan rows = window_rows(row, args.height);
  for (int i = 0; i < n; i += kLanes) {
    Vec x = splat(0.0f), y = x, xx = x, yy = x, xy = x;
    for (int k = rows.first; k <= rows.last; ++k) {
      const size_t at = size_t(row + k - kSsimRadius) * n + i;
      const Vec a = load_up_to(args.rgb + at, n - i), b = load_up_to(args.target_rgb + at, n - i);
      const Vec w = splat(kWindow[k]), wa = w * a, wb = w * b;
      x = x + wa;
      y = y + wb;
      xx = fma(wa, a, xx);
      yy = fma(wb, b, yy);
      xy = fma(wa, b, xy);
    }
    float* out = scratch + kSsimPad + i;
    store(out, x);
    store(out + stride, y);
    store(out + 2 * stride, xx);
    store(out + 3 * stride, yy);
    store(out + 4 * stride, xy);
  }
  for (int b = 0; b < 5; ++b) clear_padding(scratch + b * stride, args.width);
}

// SSIM of one row and its derivatives by mean, mean square and mean product of the rendered image.
VTSLAM_INLINE double ssim_row(const LossArgs& args, int row, const float* scratch) {
  const int n = 3 * args.width;
  const size_t stride = loss_row_floats(args.width);
  double total = 0.0;
  for (int i = 0; i < n; i += kLanes) {
    const Vec mx = filtered(scratch, i), my = filtered(scratch + stride, i);
    const Vec xx = filtered(scratch + 2 * stride, i), yy = filtered(scratch + 3 * stride, i);
    const Vec xy = filtered(scratch + 4 * stride, i);
    const Vec mean_product = mx * my, mean_squares = fma(mx, mx, my * my), two = splat(2.0f);
    const Vec a1 = fma(two, mean_product, splat(kC1)), a2 = fma(two, xy - mean_product, splat(kC2));
    const Vec b1 = mean_squares + splat(kC1), b2 = (xx + yy) - mean_squares + splat(kC2);
    const Vec inverse_b1 = splat(1.0f) / b1, inverse_b2 = splat(1.0f) / b2, inverse = inverse_b1 * inverse_b2;
    const Vec ssim = a1 * a2 * inverse;
    const Vec by_mean = two * (my * (a2 - a1) * inverse - mx * ssim * (inverse_b1 - inverse_b2));
    const size_t at = size_t(row) * n + i;
    store_up_to(args.by_mean + at, by_mean, n - i);
    store_up_to(args.by_square + at, splat(0.0f) - ssim * inverse_b2, n - i);
    store_up_to(args.by_product + at, two * a1 * inverse, n - i);
    alignas(64) float lanes[kLanes];
    store(lanes, ssim);
    double sum = 0.0;
    for (int l = 0; l < kLanes; ++l) sum += i + l < n ? double(lanes[l]) : 0.0;
    total += sum;
  }
  return total;
}

VTSLAM_INLINE float sign_of(float a) { return a > 0.0f ? 1.0f : (a < 0.0f ? -1.0f : 0.0f); }

// The L1 terms' sums over one row.
VTSLAM_INLINE void absolute_sums(const LossArgs& args, int row, LossRow* sums) {
  const size_t start = size_t(row) * args.width;
  float color[16] = {}, depth[16] = {};
  int64_t color_pixels = 0, depth_pixels = 0;
  for (int x = 0; x < args.width; ++x) {
    const size_t at = start + x;
    const bool counted = args.mask == nullptr || args.mask[at] != 0;
    const float* a = args.rgb + 3 * at;
    const float* b = args.target_rgb + 3 * at;
    const bool deep = counted && args.target_depth[at] > 0.0f;
    const float d = (__builtin_fabsf(a[0] - b[0]) + __builtin_fabsf(a[1] - b[1])) + __builtin_fabsf(a[2] - b[2]);
    color[x % 16] += counted ? d : 0.0f;
    depth[x % 16] += deep ? __builtin_fabsf(args.depth[at] - args.target_depth[at]) : 0.0f;
    color_pixels += counted;
    depth_pixels += deep;
  }
  sums->color = sums->depth = 0.0;
  for (int l = 0; l < 16; ++l) {
    sums->color += color[l];
    sums->depth += depth[l];
  }
  sums->color_pixels = color_pixels;
  sums->depth_pixels = depth_pixels;
}

void loss_statistics_row(const LossArgs& args, int row, float* scratch, LossRow* sums) {
  sums->ssim = 0.0;
  if (args.structural) {
    vertical_moments(args, row, scratch);
    sums->ssim = ssim_row(args, row, scratch);
  }
  absolute_sums(args, row, sums);
}

VTSLAM_INLINE void vertical_derivatives(const LossArgs& args, int row, float* scratch) {
  const int n = 3 * args.width;
  const size_t stride = loss_row_floats(args.width);
  const RowSpan rows = window_rows(row, args.height);
  for (int i = 0; i < n; i += kLanes) {
    Vec mean = splat(0.0f), square = mean, product = mean;
    for (int k = rows.first; k <= rows.last; ++k) {
      const size_t at = size_t(row + k - kSsimRadius) * n + i;
      const Vec w = splat(kWindow[k]);
      mean = fma(w, load_up_to(args.by_mean + at, n - i), mean);
      square = fma(w, load_up_to(args.by_square + at, n - i), square);
      product = fma(w, load_up_to(args.by_product + at, n - i), product);
    }
    store(scratch + kSsimPad + i, mean);
    store(scratch + stride + kSsimPad + i, square);
    store(scratch + 2 * stride + kSsimPad + i, product);
  }
  for (int b = 0; b < 3; ++b) clear_padding(scratch + b * stride, args.width);
}

// scale times the sign of a - b.
VTSLAM_INLINE Vec signed_scale(Vec a, Vec b, float scale) {
  return where(at_least(a, b), splat(scale)) - where(at_least(b, a), splat(scale));
}

// Adds the L1 terms of one row where only some pixels count.
VTSLAM_INLINE void add_masked_signs(const LossArgs& args, int row) {
  for (int x = 0; x < args.width; ++x) {
    const size_t at = size_t(row) * args.width + x;
    const bool counted = args.mask[at] != 0;
    for (size_t c = 3 * at; counted && c < 3 * at + 3; ++c)
      args.d_rgb[c] += args.color_scale * sign_of(args.rgb[c] - args.target_rgb[c]);
    const bool deep = counted && args.target_depth[at] > 0.0f;
    args.d_depth[at] = deep ? args.depth_scale * sign_of(args.depth[at] - args.target_depth[at]) : 0.0f;
  }
}

void loss_gradient_row(const LossArgs& args, int row, float* scratch) {
  const int n = 3 * args.width;
  const size_t stride = loss_row_floats(args.width), start = size_t(row) * args.width;
  const bool masked = args.mask != nullptr;
  if (args.structural) vertical_derivatives(args, row, scratch);
  for (int i = 0; i < n; i += kLanes) {
    const size_t at = 3 * start + i;
    const Vec a = load_up_to(args.rgb + at, n - i), b = load_up_to(args.target_rgb + at, n - i);
    Vec by_pixel = splat(0.0f);
    if (args.structural) {
      const Vec by_square = filtered(scratch + stride, i), by_product = filtered(scratch + 2 * stride, i);
      by_pixel = fma(by_product, b, fma(by_square * splat(2.0f), a, filtered(scratch, i))) * splat(-args.ssim_scale);
    }
    if (!masked) by_pixel = by_pixel + signed_scale(a, b, args.color_scale);
    store_up_to(args.d_rgb + at, by_pixel, n - i);
  }
  if (masked) return add_masked_signs(args, row);
  for (int i = 0; i < args.width; i += kLanes) {
    const size_t at = start + i;
    const int left = args.width - i;
    const Vec depth = load_up_to(args.depth + at, left), target = load_up_to(args.target_depth + at, left);
    const Vec measured = signed_scale(depth, target, args.depth_scale);
    store_up_to(args.d_depth + at, where(at_least(target, splat(kLeastDepth)), measured), left);
  }
}

void adam(const AdamArgs& args, size_t begin, size_t end) {
  const Vec b1 = splat(args.beta1), b2 = splat(args.beta2);
  const Vec c1 = splat(args.beta1_complement), c2 = splat(args.beta2_complement);
  for (size_t i = begin; i < end; i += kLanes) {
    const int n = end - i < size_t(kLanes) ? int(end - i) : kLanes;
    const Vec g = load_up_to(args.gradients + i, n);
    const Vec m = fma(b1, load_up_to(args.m + i, n), c1 * g);
    const Vec v = fma(b2, load_up_to(args.v + i, n), c2 * g * g);
    const Vec scale = fma(square_root(v), splat(args.inverse_root_bias2), splat(args.eps));
    store_up_to(args.m + i, m, n);
    store_up_to(args.v + i, v, n);
    store_up_to(args.parameters + i, load_up_to(args.parameters + i, n) - splat(args.step_size) * m / scale, n);
  }
}

}  // namespace
}  // namespace vtslam::native
