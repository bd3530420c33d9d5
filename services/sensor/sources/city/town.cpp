#include "town.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace city {
namespace {

constexpr double kNear = 0.05;  // m
constexpr std::int64_t kEmpty = std::numeric_limits<std::int64_t>::min();

int cell_of(double metres) { return static_cast<int>(std::floor(metres / CellTable::kCell)); }

std::int64_t key_of(int cell_x, int cell_z) {
  return (static_cast<std::int64_t>(cell_x) << 32) | static_cast<std::uint32_t>(cell_z);
}

// Narrows [enter, leave] to where low <= origin + t * direction <= high; says which end it enters by.
bool clipped(double origin, double direction, double low, double high, double& enter, double& leave, bool& by_high) {
  if (direction == 0.0) return origin >= low && origin <= high;
  double first = (low - origin) / direction, last = (high - origin) / direction;
  const bool from_high = first > last;
  if (from_high) std::swap(first, last);
  if (first > enter) {
    enter = first;
    by_high = from_high;
  }
  leave = std::min(leave, last);
  return enter <= leave;
}

// A ray, and its length on the ground for t = 1.
struct Ray {
  Point origin, direction;
  double ground_length;
};

double ground_length(Point direction) { return std::sqrt(direction.x * direction.x + direction.z * direction.z); }

// Whether the ray passes within a body's reach, seen from above.
bool passes(const Body& b, const Ray& ray) {
  const double x = b.x - ray.origin.x, z = b.z - ray.origin.z;
  return std::abs(x * ray.direction.z - z * ray.direction.x) <= b.reach_m * ray.ground_length;
}

// Ray in the coordinates of a body: turned, and from its middle on the ground.
struct LocalRay {
  Point origin, direction;
};

LocalRay local(const Body& b, Point origin, Point direction) {
  const double x = origin.x - b.x, z = origin.z - b.z;
  return {{b.cosine * x + b.sine * z, origin.h, b.cosine * z - b.sine * x},
          {b.cosine * direction.x + b.sine * direction.z, direction.h, b.cosine * direction.z - b.sine * direction.x}};
}

bool box_hit(const Body& b, const LocalRay& ray, Hit& best, int index) {
  double enter = kNear, leave = best.t;
  int face = -1;
  bool by_high = false;
  double before = enter;
  const auto axis = [&](double origin, double direction, double low, double high, int face_high, int face_low) {
    if (!clipped(origin, direction, low, high, enter, leave, by_high)) return false;
    if (enter > before) face = by_high ? face_high : face_low;
    before = enter;
    return true;
  };
  if (!axis(ray.origin.x, ray.direction.x, -b.half_x, b.half_x, 0, 1)) return false;
  if (!axis(ray.origin.z, ray.direction.z, -b.half_z, b.half_z, 2, 3)) return false;
  if (!axis(ray.origin.h, ray.direction.h, b.low, b.high, kTop, kBottom)) return false;
  if (face < 0) return false;  // the camera is inside
  best = {enter, index, face};
  return true;
}

bool cylinder_hit(const Body& b, const LocalRay& ray, Hit& best, int index) {
  const Point o = ray.origin, d = ray.direction;
  const double a = d.x * d.x + d.z * d.z, half = o.x * d.x + o.z * d.z;
  const double c = o.x * o.x + o.z * o.z - b.half_x * b.half_x;
  const double inside = half * half - a * c;
  if (inside < 0.0 || a == 0.0) return false;
  double enter = (-half - std::sqrt(inside)) / a, leave = std::min((-half + std::sqrt(inside)) / a, best.t);
  int face = 2;
  bool by_high = false;
  const double side = enter;
  if (!clipped(o.h, d.h, b.low, b.high, enter, leave, by_high) || enter < kNear) return false;
  if (enter > side) face = by_high ? kTop : kBottom;
  if (enter >= best.t) return false;
  best = {enter, index, face};
  return true;
}

bool ellipsoid_hit(const Body& b, const LocalRay& ray, Hit& best, int index) {
  const double stretch = 2.0 * b.half_x / (b.high - b.low), middle = 0.5 * (b.low + b.high);
  const Point o{ray.origin.x, (ray.origin.h - middle) * stretch, ray.origin.z};
  const Point d{ray.direction.x, ray.direction.h * stretch, ray.direction.z};
  const double a = dot(d, d), half = dot(o, d), inside = half * half - a * (dot(o, o) - b.half_x * b.half_x);
  if (inside < 0.0) return false;
  const double t = (-half - std::sqrt(inside)) / a;
  if (t < kNear || t >= best.t) return false;
  best = {t, index, 2};
  return true;
}

void body_hit(const Body& b, const Ray& whole, Hit& best, int index) {
  if (!passes(b, whole)) return;
  const LocalRay ray = local(b, whole.origin, whole.direction);
  bool found = false;
  if (b.kind == Kind::kBox) found = box_hit(b, ray, best, index);
  if (b.kind == Kind::kCylinder) found = cylinder_hit(b, ray, best, index);
  if (b.kind == Kind::kEllipsoid) found = ellipsoid_hit(b, ray, best, index);
  if (found && best.face < kTop && whole.origin.h + best.t * whole.direction.h < b.foot_m) best.face += kFoot;
}

CellTable::Bounds bounds_of(const Body& b) {
  double dx = b.half_x, dz = b.half_x;
  if (b.kind == Kind::kBox) {
    dx = std::abs(b.cosine) * b.half_x + std::abs(b.sine) * b.half_z;
    dz = std::abs(b.sine) * b.half_x + std::abs(b.cosine) * b.half_z;
  }
  return {b.x - dx, b.x + dx, b.z - dz, b.z + dz};
}

CellTable::Bounds bounds_of(const Street& s) {
  return {std::min(s.x0, s.x1) - kVerge, std::max(s.x0, s.x1) + kVerge, std::min(s.z0, s.z1) - kVerge,
          std::max(s.z0, s.z1) + kVerge};
}

template <class Item>
std::vector<CellTable::Bounds> all_bounds(const std::vector<Item>& items) {
  std::vector<CellTable::Bounds> out;
  for (const Item& item : items) out.push_back(bounds_of(item));
  return out;
}

}  // namespace

CellTable::CellTable(const std::vector<Bounds>& bounds) {
  std::vector<std::pair<std::int64_t, int>> entries;
  for (std::size_t i = 0; i < bounds.size(); ++i) {
    for (int x = cell_of(bounds[i].x0); x <= cell_of(bounds[i].x1); ++x) {
      for (int z = cell_of(bounds[i].z0); z <= cell_of(bounds[i].z1); ++z) {
        entries.emplace_back(key_of(x, z), static_cast<int>(i));
      }
    }
  }
  std::sort(entries.begin(), entries.end());
  std::size_t cells = 0, size = 16;
  for (std::size_t i = 0; i < entries.size(); ++i) cells += i == 0 || entries[i].first != entries[i - 1].first;
  while (size < 2 * cells) size *= 2;
  slots_.assign(size, {kEmpty, 0, 0});
  for (const auto& [key, item] : entries) {
    Slot& slot = slots_[slot_of(key)];
    if (slot.key == kEmpty) slot = {key, static_cast<int>(items_.size()), static_cast<int>(items_.size())};
    items_.push_back(item);
    ++slot.end;
  }
}

std::size_t CellTable::slot_of(std::int64_t key) const {
  std::uint64_t h = static_cast<std::uint64_t>(key) * 0x9e3779b97f4a7c15ull;
  h ^= h >> 29;
  std::size_t slot = h & (slots_.size() - 1);
  while (slots_[slot].key != kEmpty && slots_[slot].key != key) slot = (slot + 1) & (slots_.size() - 1);
  return slot;
}

CellTable::Range CellTable::at(int cell_x, int cell_z) const {
  const Slot& slot = slots_[slot_of(key_of(cell_x, cell_z))];
  return {items_.data() + slot.begin, items_.data() + slot.end};
}

Town::Town(std::vector<Body> bodies, std::vector<Street> streets, std::vector<raycast::Texture> textures)
    : bodies_(std::move(bodies)),
      streets_(std::move(streets)),
      textures_(std::move(textures)),
      body_cells_(all_bounds(bodies_)),
      street_cells_(all_bounds(streets_)) {
  for (const Body& b : bodies_) highest_ = std::max(highest_, b.high);
}

const Body& Town::body(int index, const std::vector<Body>& moving) const {
  const std::size_t i = static_cast<std::size_t>(index);
  return i < bodies_.size() ? bodies_[i] : moving[i - bodies_.size()];
}

Hit Town::cast(Point origin, Point direction, const std::vector<Body>& moving) const {
  Hit best{kFarthest};
  if (direction.h < 0.0 && -origin.h / direction.h < best.t) best = {-origin.h / direction.h, kGround, 0};
  double limit = best.t;
  if (direction.h > 0.0) limit = std::min(limit, std::max(highest_ - origin.h, 0.0) / direction.h);
  cast_static(origin, direction, limit, best);
  const Ray ray{origin, direction, ground_length(direction)};
  for (std::size_t i = 0; i < moving.size(); ++i) {
    body_hit(moving[i], ray, best, static_cast<int>(bodies_.size() + i));
  }
  return best;
}

void Town::cast_static(Point origin, Point direction, double limit, Hit& best) const {
  const Ray ray{origin, direction, ground_length(direction)};
  constexpr double kCell = CellTable::kCell, kNever = std::numeric_limits<double>::infinity();
  int x = cell_of(origin.x), z = cell_of(origin.z);
  const int step_x = direction.x < 0.0 ? -1 : 1, step_z = direction.z < 0.0 ? -1 : 1;
  const auto to_border = [&](int cell, int step, double from, double way) {
    return way == 0.0 ? kNever : ((cell + (step > 0 ? 1 : 0)) * kCell - from) / way;
  };
  for (double entered = 0.0; entered < std::min(limit, best.t);) {
    const CellTable::Range range = body_cells_.at(x, z);
    for (const int* i = range.begin; i != range.end; ++i) body_hit(bodies_[*i], ray, best, *i);
    const double leave_x = to_border(x, step_x, origin.x, direction.x);
    const double leave_z = to_border(z, step_z, origin.z, direction.z);
    entered = std::min(leave_x, leave_z);
    (leave_x < leave_z ? x : z) += leave_x < leave_z ? step_x : step_z;
  }
}

StreetPlace Town::street_at(double x, double z) const {
  StreetPlace best{false, kVerge, 0.0, 1.0, 0.0};
  const CellTable::Range range = street_cells_.at(cell_of(x), cell_of(z));
  for (const int* i = range.begin; i != range.end; ++i) {
    const Street& s = streets_[*i];
    const double way_x = s.x1 - s.x0, way_z = s.z1 - s.z0, length = std::sqrt(way_x * way_x + way_z * way_z);
    const double ux = way_x / length, uz = way_z / length;
    const double along = std::clamp((x - s.x0) * ux + (z - s.z0) * uz, 0.0, length);
    const double dx = x - s.x0 - along * ux, dz = z - s.z0 - along * uz, away = std::sqrt(dx * dx + dz * dz);
    if (away < best.beside_m) best = {true, away, s.start_m + along, ux, uz};
  }
  return best;
}

}  // namespace city
