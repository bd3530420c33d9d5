// Elementary functions on vectors, and the places of the gradient sums. Include a simd_*.hpp first.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace vtslam::native {
namespace {

constexpr float kLog2E = 1.44269504088896f, kLn2 = 0.693147180559945f;

// Sums over pixels that the backward pass keeps for each (Gaussian, tile) pair. With g = alpha dL/dalpha and d the
// offset of the pixel centre from the mean: colour weights, the sums of g, weights and g d d^T; and, where derivatives
// by the geometry are wanted, of g d and of depth weights.
enum { kSumRed, kSumGreen, kSumBlue, kSumAlpha, kSumWeight, kSumXX, kSumXY, kSumYY, kSumX, kSumY, kSumDepth };
constexpr int kFewSums = kSumX, kAllSums = 12;

// 2^f for f in [0, 1], minimax of degree 5, relative error below 3e-7; in a form with a short chain of dependences.
VTSLAM_INLINE Vec exp2_fraction(Vec f) {
  const Vec f2 = f * f;
  const Vec high = fma(splat(0.00187757600f), f, splat(0.00898934249f));
  const Vec middle = fma(splat(0.0558263138f), f, splat(0.240153626f));
  const Vec low = fma(splat(0.693153083f), f, splat(0.99999994f));
  return fma(fma(high, f2, middle), f2, low);
}

VTSLAM_INLINE Vec exp2_of(Vec a) {
  Vec n;
  const Vec f = fraction_of(bounded_exponent(a), n);
  return scaled_by_power(exp2_fraction(f), n);
}

// exp with the argument reduced in two parts of ln 2, so that large arguments keep the relative error.
VTSLAM_INLINE Vec exp_of(Vec a) {
  const Vec n = rounded(bounded_exponent(a * splat(kLog2E)) - splat(0.5f));
  const Vec r = fnma(n, splat(-2.12194440e-4f), fnma(n, splat(0.693359375f), a));
  const Vec f = minimum(maximum(r * splat(kLog2E), splat(0.0f)), splat(1.0f));  // beyond only where 2^n saturates
  return scaled_by_power(exp2_fraction(f), n);
}

// Binary logarithm of a positive normal number, absolute error below 2e-7 near 1.
VTSLAM_INLINE Vec log2_of(Vec a) {
  Vec exponent;
  const Vec t = split_mantissa(a, exponent) - splat(1.0f);
  Vec p = fma(splat(-0.0643435270f), t, splat(0.150666326f));
  p = fma(p, t, splat(-0.190278396f));
  p = fma(p, t, splat(0.209101096f));
  p = fma(p, t, splat(-0.240148231f));
  p = fma(p, t, splat(0.288384020f));
  p = fma(p, t, splat(-0.360674858f));
  p = fma(p, t, splat(0.480900764f));
  p = fma(p, t, splat(-0.721347511f));
  p = fma(p, t, splat(1.44269502f));
  return fma(p, t, exponent);
}

VTSLAM_INLINE float log2_scalar(float a) {
  alignas(64) float lanes[kLanes];
  store(lanes, log2_of(splat(a)));
  return lanes[0];
}

// n < kLanes values, the others zero.
VTSLAM_INLINE Vec load_first(const float* p, int n) {
  alignas(64) float lanes[kLanes] = {};
  for (int i = 0; i < n; ++i) lanes[i] = p[i];
  return load(lanes);
}

VTSLAM_INLINE void store_first(float* p, Vec a, int n) {
  alignas(64) float lanes[kLanes];
  store(lanes, a);
  for (int i = 0; i < n; ++i) p[i] = lanes[i];
}

// Sum of the lanes, in double.
VTSLAM_INLINE double sum_of(Vec a) {
  alignas(64) float lanes[kLanes];
  store(lanes, a);
  double total = 0.0;
  for (int i = 0; i < kLanes; ++i) total += lanes[i];
  return total;
}

}  // namespace
}  // namespace vtslam::native
