// Vectors, 3x3 matrices and the few functions that libm would compute differently from machine to machine.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

namespace raycast {

struct Vec3 {
  double x = 0.0, y = 0.0, z = 0.0;
  double operator[](int i) const { return i == 0 ? x : (i == 1 ? y : z); }
};

inline Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, Vec3 a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 absolute(Vec3 a) { return {std::abs(a.x), std::abs(a.y), std::abs(a.z)}; }
inline double norm(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 normalized(Vec3 a) { return (1.0 / norm(a)) * a; }

// Row-major 3x3 matrix.
struct Mat3 {
  double m[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  Vec3 row(int i) const { return {m[3 * i], m[3 * i + 1], m[3 * i + 2]}; }
  Vec3 column(int j) const { return {m[j], m[3 + j], m[6 + j]}; }
};

inline Vec3 operator*(const Mat3& a, Vec3 v) { return {dot(a.row(0), v), dot(a.row(1), v), dot(a.row(2), v)}; }
inline Vec3 transposed_times(const Mat3& a, Vec3 v) {
  return {dot(a.column(0), v), dot(a.column(1), v), dot(a.column(2), v)};
}

// Angle of (x, y) in radians, -pi to pi, to about 1e-5; for texture coordinates only.
inline double polar_angle(double y, double x) {
  const double ax = std::abs(x), ay = std::abs(y);
  const double q = std::min(ax, ay) / std::max(std::max(ax, ay), 1e-300);
  const double s = q * q;
  double angle =
      q * (0.99997726 + s * (-0.33262347 + s * (0.19354346 + s * (-0.11643287 + s * (0.05265332 - s * 0.01172120)))));
  if (ay > ax) angle = 1.5707963267948966 - angle;
  if (x < 0.0) angle = 3.141592653589793 - angle;
  return y < 0.0 ? -angle : angle;
}

// log2 of x > 0, linear between powers of two: exact there, at most 0.086 off between; for mip levels only.
inline float coarse_log2(float x) {
  std::uint32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  const int exponent = static_cast<int>(bits >> 23) - 127;
  bits = (bits & 0x7fffffu) | 0x3f800000u;
  float mantissa;
  std::memcpy(&mantissa, &bits, sizeof mantissa);
  return static_cast<float>(exponent) + (mantissa - 1.0f);
}

}  // namespace raycast
