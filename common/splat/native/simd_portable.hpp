// Four float lanes with the compiler's vector types (SSE2, NEON or plain code); a pixel block is 4x1.
#pragma once

#include <stdint.h>

namespace vtslam::native {
namespace {

#define VTSLAM_INLINE static inline __attribute__((always_inline))

typedef float Vec __attribute__((vector_size(16)));
typedef int32_t Mask __attribute__((vector_size(16)));
constexpr int kLanes = 4, kBlockWidth = 4, kBlockHeight = 1;

VTSLAM_INLINE Vec splat(float x) { return Vec{x, x, x, x}; }
VTSLAM_INLINE Vec load(const float* p) {
  Vec a;
  __builtin_memcpy(&a, p, sizeof a);
  return a;
}
VTSLAM_INLINE void store(float* p, Vec a) { __builtin_memcpy(p, &a, sizeof a); }
VTSLAM_INLINE Vec fma(Vec a, Vec b, Vec c) { return a * b + c; }
VTSLAM_INLINE Vec fnma(Vec a, Vec b, Vec c) { return c - a * b; }
VTSLAM_INLINE Mask bits(Vec a) { return (Mask)a; }
VTSLAM_INLINE Vec from_bits(Mask a) { return (Vec)a; }
VTSLAM_INLINE Mask at_least(Vec a, Vec b) { return a >= b; }
VTSLAM_INLINE Mask both(Mask a, Mask b) { return a & b; }
VTSLAM_INLINE bool any(Mask a) { return (a[0] | a[1] | a[2] | a[3]) != 0; }
VTSLAM_INLINE Vec select(Mask m, Vec a, Vec b) { return from_bits((bits(a) & m) | (bits(b) & ~m)); }
VTSLAM_INLINE Vec where(Mask m, Vec a) { return from_bits(bits(a) & m); }
VTSLAM_INLINE Vec minimum(Vec a, Vec b) { return select(a < b, a, b); }
VTSLAM_INLINE Vec maximum(Vec a, Vec b) { return select(a > b, a, b); }
VTSLAM_INLINE Vec absolute(Vec a) { return from_bits(bits(a) & 0x7FFFFFFF); }
VTSLAM_INLINE Vec negative(Vec a) { return from_bits(bits(a) | bits(splat(-0.0f))); }  // -|a|
VTSLAM_INLINE Vec square_root(Vec a) {
  return Vec{__builtin_sqrtf(a[0]), __builtin_sqrtf(a[1]), __builtin_sqrtf(a[2]), __builtin_sqrtf(a[3])};
}
// To the nearest whole number, for |a| below 2^22: the sum has no room left for a fraction.
VTSLAM_INLINE Vec rounded(Vec a) { return (a + splat(12582912.0f)) - splat(12582912.0f); }

// Exponents that scaled_by_power can take.
VTSLAM_INLINE Vec bounded_exponent(Vec a) { return minimum(maximum(a, splat(-126.0f)), splat(128.0f)); }

// a * 2^n for whole n in [-126, 128].
VTSLAM_INLINE Vec scaled_by_power(Vec a, Vec n) {
  const Mask e = __builtin_convertvector(n, Mask);
  return a * from_bits((e + 127) << 23);
}
// Splits a into a fraction in [0, 1], returned, and a whole part for scaled_by_power.
VTSLAM_INLINE Vec fraction_of(Vec a, Vec& n) {
  n = rounded(a - splat(0.5f));
  return a - n;
}
VTSLAM_INLINE Vec reciprocal(Vec a) { return 1.0f / a; }

// Splits positive normal a into 2^exponent * mantissa, mantissa in [0.75, 1.5).
VTSLAM_INLINE Vec split_mantissa(Vec a, Vec& exponent) {
  const Mask e = (bits(a) - 0x3F400000) >> 23;
  exponent = __builtin_convertvector(e, Vec);
  return from_bits(bits(a) - (e << 23));
}

// Eight or twelve vectors to their sums; float slot_lane<count>(i) of the result is the sum of v[i].
template <int count>
constexpr int slot_lane(int i) {
  return i;
}
template <int count>
VTSLAM_INLINE void store_sums(float* out, const Vec (&v)[count]) {
  for (int i = 0; i < count; ++i) out[i] = (v[i][0] + v[i][1]) + (v[i][2] + v[i][3]);
  for (int i = count; i < (count + 7) / 8 * 8; ++i) out[i] = 0.0f;
}

}  // namespace
}  // namespace vtslam::native
