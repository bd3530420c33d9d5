// The static world: primitives with textured faces, lights, and the distance grid that shades corners.
#pragma once

#include <array>
#include <vector>

#include "texture.hpp"
#include "vec.hpp"

namespace raycast {

// kRoom is a box seen from inside. kCone is a truncated cone along local z (a cylinder where both radii agree).
enum class Kind : int { kBox = 0, kRoom = 1, kCone = 2, kEllipsoid = 3 };

struct Surface {
  int texture;
  float u0, v0;  // texture coordinates of the face centre, in texture units
  float su, sv;  // texture units per metre
  Rgb tint;      // multiplies the texture
  float glow;    // light given off, added to the light received
};

// size: box and room half extents; cone bottom radius, top radius, half height; ellipsoid semi-axes (all m).
// Faces of a box: +x, -x, +y, -y, +z, -z. Of a cone: side, top, bottom. An ellipsoid has one.
struct Primitive {
  Kind kind;
  Vec3 centre;
  Mat3 rotation;  // object to world
  Vec3 size;
  std::array<Surface, 6> faces;
};

struct Light {
  Vec3 position;
  Rgb strength;
  double reach_m;  // at this distance the light has fallen to half
};

// A surface point in object coordinates: outward normal, texture axes and coordinates in metres from the face centre.
struct SurfacePoint {
  Vec3 normal, u_axis, v_axis;
  double u_m, v_m;
};

// Nearest intersection with t > near of origin + t * direction (object coordinates); t < 0 where there is none.
struct Intersection {
  double t = -1.0;
  int face = 0;
};

Intersection intersected(const Primitive& primitive, Vec3 origin, Vec3 direction, double near);
SurfacePoint surface_point(const Primitive& primitive, Vec3 point, int face);
// Signed distance (m, about; negative inside matter) from a world point to the surface.
double signed_distance(const Primitive& primitive, Vec3 point_world);
// Half extents of the world-aligned box around the primitive's centre that holds it.
Vec3 half_bounds(const Primitive& primitive);

constexpr double kFarthest = 0.6;  // m
constexpr std::size_t kMaxLights = 4;

class Scene {
 public:
  Scene(std::vector<Primitive> primitives, std::vector<Texture> textures, std::vector<Light> lights, Rgb ambient,
        int num_threads);

  const std::vector<Primitive>& primitives() const { return primitives_; }
  const Texture& texture(int index) const { return textures_[index]; }
  // Light (1 = full) reaching a point with the given normal, both in world coordinates: the same from every view.
  Rgb irradiance(Vec3 point, Vec3 normal) const;
  // Signed distance (m) to the nearest surface, read off the grid; at most kFarthest.
  double clearance_m(Vec3 point) const;

 private:
  void fill_grids(int num_threads);
  Rgb lights_seen(Vec3 point) const;
  // Value between the nodes of a grid of numbers or of vectors, at a world point (held inside the grid).
  template <class Value>
  Value interpolated(const std::vector<Value>& grid, Vec3 point) const;

  std::vector<Primitive> primitives_;
  std::vector<Texture> textures_;
  std::vector<Light> lights_;
  Rgb ambient_;
  Vec3 grid_origin_;
  std::array<int, 3> grid_size_{};
  std::vector<float> distance_;  // signed distance at the grid nodes, capped at kFarthest
  std::vector<Rgb> visible_;     // the part of each light (one a lane, 0 to 1) that reaches the grid nodes
};

}  // namespace raycast
