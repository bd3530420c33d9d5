// Sixteen float lanes in one AVX-512 register; a pixel block is 4x4.
#pragma once

#include <immintrin.h>

namespace vtslam::native {
namespace {

#define VTSLAM_INLINE static inline __attribute__((always_inline))

using Vec = __m512;
using Mask = __mmask16;
constexpr int kLanes = 16, kBlockWidth = 4, kBlockHeight = 4;

VTSLAM_INLINE Vec splat(float x) { return _mm512_set1_ps(x); }
VTSLAM_INLINE Vec load(const float* p) { return _mm512_loadu_ps(p); }
VTSLAM_INLINE void store(float* p, Vec a) { _mm512_storeu_ps(p, a); }
VTSLAM_INLINE Vec fma(Vec a, Vec b, Vec c) { return _mm512_fmadd_ps(a, b, c); }
VTSLAM_INLINE Vec fnma(Vec a, Vec b, Vec c) { return _mm512_fnmadd_ps(a, b, c); }  // c - a b
VTSLAM_INLINE Vec minimum(Vec a, Vec b) { return _mm512_min_ps(a, b); }
VTSLAM_INLINE Vec maximum(Vec a, Vec b) { return _mm512_max_ps(a, b); }
VTSLAM_INLINE Vec square_root(Vec a) { return _mm512_sqrt_ps(a); }
VTSLAM_INLINE Vec absolute(Vec a) { return _mm512_abs_ps(a); }
VTSLAM_INLINE Mask at_least(Vec a, Vec b) { return _mm512_cmp_ps_mask(a, b, _CMP_GE_OQ); }
VTSLAM_INLINE Mask both(Mask a, Mask b) { return a & b; }
VTSLAM_INLINE bool any(Mask a) { return a != 0; }
VTSLAM_INLINE Vec select(Mask m, Vec a, Vec b) { return _mm512_mask_blend_ps(m, b, a); }
VTSLAM_INLINE Vec where(Mask m, Vec a) { return _mm512_maskz_mov_ps(m, a); }
VTSLAM_INLINE Vec negative(Vec a) { return _mm512_or_ps(a, splat(-0.0f)); }  // -|a|
VTSLAM_INLINE Vec rounded(Vec a) { return _mm512_roundscale_ps(a, 0); }
// Splits a into a fraction in [0, 1), returned, and a part n for scaled_by_power (which takes its floor).
VTSLAM_INLINE Vec fraction_of(Vec a, Vec& n) {
  n = a;
  return _mm512_reduce_ps(a, 1);
}
VTSLAM_INLINE Vec bounded_exponent(Vec a) { return a; }
VTSLAM_INLINE Vec scaled_by_power(Vec a, Vec n) { return _mm512_scalef_ps(a, n); }

// 1 / a to about 1 unit in the last place (estimate of 14 bits and one Newton step); a normal and not zero.
VTSLAM_INLINE Vec reciprocal(Vec a) {
  const Vec r = _mm512_rcp14_ps(a);
  return fma(r, fnma(a, r, splat(1.0f)), r);
}

// Splits positive normal a into 2^exponent * mantissa, mantissa in [0.75, 1.5).
VTSLAM_INLINE Vec split_mantissa(Vec a, Vec& exponent) {
  const Vec m = _mm512_getmant_ps(a, _MM_MANT_NORM_p75_1p5, _MM_MANT_SIGN_src);
  exponent = _mm512_getexp_ps(a / m);
  return m;
}

// Eight or twelve vectors to their sums; float slot_lane<count>(i) of the result is the sum of v[i].
template <int count>
constexpr int slot_lane(int i) {
  return count / 4 * (i % 4) + i / 4 + (count == 12 ? i % 4 : 0);
}
VTSLAM_INLINE Vec fold_halves(Vec a, Vec b) {
  return _mm512_shuffle_f32x4(a, b, 0x44) + _mm512_shuffle_f32x4(a, b, 0xEE);
}
VTSLAM_INLINE Vec fold_quarters(Vec a, Vec b) {
  return _mm512_shuffle_f32x4(a, b, 0x88) + _mm512_shuffle_f32x4(a, b, 0xDD);
}
VTSLAM_INLINE void store_sums(float* out, const Vec (&v)[8]) {
  const Vec x = fold_quarters(fold_halves(v[0], v[1]), fold_halves(v[2], v[3]));
  const Vec y = fold_quarters(fold_halves(v[4], v[5]), fold_halves(v[6], v[7]));
  const Vec xy = _mm512_unpacklo_ps(x, y) + _mm512_unpackhi_ps(x, y);
  const __m512d sums = _mm512_castps_pd(xy + _mm512_shuffle_ps(xy, xy, 0x4E));
  _mm256_store_pd(reinterpret_cast<double*>(out), _mm512_castpd512_pd256(_mm512_maskz_compress_pd(0x55, sums)));
}
VTSLAM_INLINE void store_sums(float* out, const Vec (&v)[12]) {
  const Vec zero = _mm512_setzero_ps();
  const Vec x = fold_quarters(fold_halves(v[0], v[1]), fold_halves(v[2], v[3]));
  const Vec y = fold_quarters(fold_halves(v[4], v[5]), fold_halves(v[6], v[7]));
  const Vec z = fold_quarters(fold_halves(v[8], v[9]), fold_halves(v[10], v[11]));
  const Vec xy = _mm512_unpacklo_ps(x, y) + _mm512_unpackhi_ps(x, y);
  const Vec z0 = _mm512_unpacklo_ps(z, zero) + _mm512_unpackhi_ps(z, zero);
  _mm512_store_ps(out, _mm512_shuffle_ps(xy, z0, 0x44) + _mm512_shuffle_ps(xy, z0, 0xEE));
}

}  // namespace
}  // namespace vtslam::native
