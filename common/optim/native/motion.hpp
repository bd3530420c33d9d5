// Points, rigid motions and the pinhole camera in float, as the alignment kernels use them.
#pragma once

#include "alignment.hpp"

namespace vtslam {
namespace {

struct Point {
  float x, y, z;
};

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

}  // namespace
}  // namespace vtslam
