// A town: upright bodies and streets on flat ground, found by the cell of the ground plane they stand in.
//
// Coordinates: x and z span the ground, h is the height above it (m). Angles are turns about the upward axis.
#pragma once

#include <cstdint>
#include <vector>

#include "texture.hpp"

namespace city {

struct Point {
  double x, h, z;
};

inline Point operator+(Point a, Point b) { return {a.x + b.x, a.h + b.h, a.z + b.z}; }
inline Point operator-(Point a, Point b) { return {a.x - b.x, a.h - b.h, a.z - b.z}; }
inline Point operator*(double s, Point a) { return {s * a.x, s * a.h, s * a.z}; }
inline double dot(Point a, Point b) { return a.x * b.x + a.h * b.h + a.z * b.z; }

enum class Kind : int { kBox = 0, kCylinder = 1, kEllipsoid = 2 };
constexpr int kNumKinds = 3;

// A texture laid on a face: what its width and height cover, from the middle and from the top of the face on.
struct Cover {
  int texture;
  double width_m, height_m;
};

// half_x, half_z: half lengths of a box's sides; the radius of a round body (half_z is then not used).
struct Body {
  Kind kind;
  double x, z;          // middle
  double cosine, sine;  // of the turn: local x points to (cosine, sine) on the ground
  double half_x, half_z;
  double low, high;   // heights of bottom and top
  Cover side, end;    // faces across local z (and round ones), faces across local x
  Cover foot;         // sides below foot_m
  double foot_m;      // 0: none
  raycast::Rgb tint;  // multiplies the texture, not the foot's
  double shift;       // moves stains, so that no two bodies have the same
  double reach_m;     // from the middle to the farthest point of the outline on the ground
};

// A straight piece of a street's middle line.
struct Street {
  double x0, z0, x1, z1;
  double start_m;  // length of the line before it
};

// Place of a ground point beside the nearest street.
struct StreetPlace {
  bool near;        // whether there is a street within kVerge
  double beside_m;  // distance from the middle line
  double along_m;
  double way_x, way_z;  // unit direction of the street
};

constexpr double kVerge = 9.5;       // m beside a middle line that belong to a street
constexpr double kFarthest = 255.0;  // m along the optical axis

constexpr int kNothing = -1, kGround = -2;

// Faces of a box: 0 +x, 1 -x, 2 +z, 3 -z, 4 top, 5 bottom. Round bodies: 2 all around, 4 and 5 the ends.
// kFoot is added for the foot of a side.
constexpr int kTop = 4, kBottom = 5, kFoot = 8;

struct Hit {
  double t;
  int body = kNothing;
  int face = 0;
  bool same_face(const Hit& other) const { return body == other.body && face == other.face; }
};

// Cells of the ground plane in a hash table: only cells that hold something take memory.
class CellTable {
 public:
  struct Range {
    const int* begin;
    const int* end;
  };
  struct Bounds {
    double x0, x1, z0, z1;
  };
  // Item i is found in every cell that bounds[i] meets.
  explicit CellTable(const std::vector<Bounds>& bounds);
  Range at(int cell_x, int cell_z) const;

  static constexpr double kCell = 8.0;  // m

 private:
  struct Slot {
    std::int64_t key;
    int begin, end;
  };
  std::size_t slot_of(std::int64_t key) const;

  std::vector<Slot> slots_;  // a power of two of them, at most half of them used
  std::vector<int> items_;
};

class Town {
 public:
  Town(std::vector<Body> bodies, std::vector<Street> streets, std::vector<raycast::Texture> textures);

  // First surface on origin + t * direction, 0 < t <= kFarthest: a body of the town, one of `moving` (numbered on from
  // the town's) or the ground.
  Hit cast(Point origin, Point direction, const std::vector<Body>& moving) const;
  const Body& body(int index, const std::vector<Body>& moving) const;
  StreetPlace street_at(double x, double z) const;
  const raycast::Texture& texture(int index) const { return textures_[index]; }
  int num_textures() const { return static_cast<int>(textures_.size()); }

 private:
  void cast_static(Point origin, Point direction, double limit, Hit& best) const;

  std::vector<Body> bodies_;
  std::vector<Street> streets_;
  std::vector<raycast::Texture> textures_;
  CellTable body_cells_, street_cells_;
  double highest_ = 0.0;
};

}  // namespace city
