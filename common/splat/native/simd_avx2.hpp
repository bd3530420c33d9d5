// Eight float lanes in one AVX register; a pixel block is 4x2.
#pragma once

#include <immintrin.h>

namespace vtslam::native {
namespace {

#define VTSLAM_INLINE static inline __attribute__((always_inline))

using Vec = __m256;
using Mask = __m256;
constexpr int kLanes = 8, kBlockWidth = 4, kBlockHeight = 2;

VTSLAM_INLINE Vec splat(float x) { return _mm256_set1_ps(x); }
VTSLAM_INLINE Vec load(const float* p) { return _mm256_loadu_ps(p); }
VTSLAM_INLINE void store(float* p, Vec a) { _mm256_storeu_ps(p, a); }
VTSLAM_INLINE Vec fma(Vec a, Vec b, Vec c) { return _mm256_fmadd_ps(a, b, c); }
VTSLAM_INLINE Vec fnma(Vec a, Vec b, Vec c) { return _mm256_fnmadd_ps(a, b, c); }  // c - a b
VTSLAM_INLINE Vec minimum(Vec a, Vec b) { return _mm256_min_ps(a, b); }
VTSLAM_INLINE Vec maximum(Vec a, Vec b) { return _mm256_max_ps(a, b); }
VTSLAM_INLINE Vec square_root(Vec a) { return _mm256_sqrt_ps(a); }
VTSLAM_INLINE Vec absolute(Vec a) { return _mm256_andnot_ps(splat(-0.0f), a); }
VTSLAM_INLINE Mask at_least(Vec a, Vec b) { return _mm256_cmp_ps(a, b, _CMP_GE_OQ); }
VTSLAM_INLINE Mask both(Mask a, Mask b) { return _mm256_and_ps(a, b); }
VTSLAM_INLINE bool any(Mask a) { return _mm256_movemask_ps(a) != 0; }
VTSLAM_INLINE Vec select(Mask m, Vec a, Vec b) { return _mm256_blendv_ps(b, a, m); }
VTSLAM_INLINE Vec where(Mask m, Vec a) { return _mm256_and_ps(m, a); }
VTSLAM_INLINE Vec negative(Vec a) { return _mm256_or_ps(a, splat(-0.0f)); }  // -|a|
VTSLAM_INLINE Vec rounded(Vec a) { return _mm256_round_ps(a, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC); }

// Exponents that scaled_by_power can take.
VTSLAM_INLINE Vec bounded_exponent(Vec a) { return minimum(maximum(a, splat(-126.0f)), splat(128.0f)); }

// a * 2^n for whole n in [-126, 128].
VTSLAM_INLINE Vec scaled_by_power(Vec a, Vec n) {
  const __m256i e = _mm256_cvtps_epi32(n);
  return a * _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_add_epi32(e, _mm256_set1_epi32(127)), 23));
}

// Splits a into a fraction in [0, 1), returned, and a whole part for scaled_by_power.
VTSLAM_INLINE Vec fraction_of(Vec a, Vec& n) {
  n = _mm256_floor_ps(a);
  return a - n;
}

// 1 / a to about 1 unit in the last place (estimate of 12 bits and one Newton step); a normal and not zero.
VTSLAM_INLINE Vec reciprocal(Vec a) {
  const Vec r = _mm256_rcp_ps(a);
  return fma(r, fnma(a, r, splat(1.0f)), r);
}

// Splits positive normal a into 2^exponent * mantissa, mantissa in [0.75, 1.5).
VTSLAM_INLINE Vec split_mantissa(Vec a, Vec& exponent) {
  const __m256i shifted = _mm256_sub_epi32(_mm256_castps_si256(a), _mm256_set1_epi32(0x3F400000));
  const __m256i e = _mm256_srai_epi32(shifted, 23);
  exponent = _mm256_cvtepi32_ps(e);
  return _mm256_castsi256_ps(_mm256_sub_epi32(_mm256_castps_si256(a), _mm256_slli_epi32(e, 23)));
}

// Eight or twelve vectors to their sums; float slot_lane<count>(i) of the result is the sum of v[i].
template <int count>
constexpr int slot_lane(int i) {
  return i;
}
VTSLAM_INLINE Vec fold_four(Vec a, Vec b, Vec c, Vec d) {
  return _mm256_hadd_ps(_mm256_hadd_ps(a, b), _mm256_hadd_ps(c, d));
}
VTSLAM_INLINE void store_eight(float* out, Vec a, Vec b) {
  _mm256_store_ps(out, _mm256_permute2f128_ps(a, b, 0x20) + _mm256_permute2f128_ps(a, b, 0x31));
}
VTSLAM_INLINE void store_sums(float* out, const Vec (&v)[8]) {
  store_eight(out, fold_four(v[0], v[1], v[2], v[3]), fold_four(v[4], v[5], v[6], v[7]));
}
VTSLAM_INLINE void store_sums(float* out, const Vec (&v)[12]) {
  store_eight(out, fold_four(v[0], v[1], v[2], v[3]), fold_four(v[4], v[5], v[6], v[7]));
  store_eight(out + 8, fold_four(v[8], v[9], v[10], v[11]), _mm256_setzero_ps());
}

}  // namespace
}  // namespace vtslam::native
