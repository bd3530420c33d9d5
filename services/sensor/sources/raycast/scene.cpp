#include "scene.hpp"

#include <limits>

#include "parallel.hpp"

namespace raycast {
namespace {

constexpr double kGridStep = 0.08;  // m
constexpr double kInfinity = std::numeric_limits<double>::infinity();
constexpr double kShadowSharpness = 5.0;  // smaller is softer
constexpr double kShadowLift = 0.07;      // m along the normal, so that a face does not shade itself

double away_from_zero(double x) { return std::abs(x) < 1e-12 ? 1e-12 : x; }

Intersection box_hit(const Primitive& p, Vec3 o, Vec3 d, double near) {
  double enter = -kInfinity, leave = kInfinity;
  int enter_axis = 0, leave_axis = 0;
  const auto cut = [&](int axis, double origin, double direction, double half) {
    const double inverse = 1.0 / away_from_zero(direction);
    const double a = (-half - origin) * inverse, b = (half - origin) * inverse;
    const double first = std::min(a, b), last = std::max(a, b);
    if (first > enter) enter = first, enter_axis = axis;
    if (last < leave) leave = last, leave_axis = axis;
  };
  cut(0, o.x, d.x, p.size.x);
  cut(1, o.y, d.y, p.size.y);
  cut(2, o.z, d.z, p.size.z);
  if (enter > leave) return {};
  if (p.kind == Kind::kRoom) {
    return leave > near ? Intersection{leave, 2 * leave_axis + (d[leave_axis] > 0.0 ? 0 : 1)} : Intersection{};
  }
  return enter > near ? Intersection{enter, 2 * enter_axis + (d[enter_axis] > 0.0 ? 1 : 0)} : Intersection{};
}

Intersection cone_hit(const Primitive& p, Vec3 o, Vec3 d, double near) {
  const double bottom = p.size.x, top = p.size.y, half = p.size.z;
  const double slope = (top - bottom) / (2.0 * half), middle = 0.5 * (top + bottom);
  Intersection best{kInfinity, 0};
  const auto offer = [&](double t, int face) {
    if (t > near && t < best.t) best = {t, face};
  };
  const double radius = middle + slope * o.z;
  const double a = away_from_zero(d.x * d.x + d.y * d.y - slope * slope * d.z * d.z);
  const double b = o.x * d.x + o.y * d.y - radius * slope * d.z;
  const double c = o.x * o.x + o.y * o.y - radius * radius;
  const double discriminant = b * b - a * c;
  if (discriminant >= 0.0) {
    const double root = std::sqrt(discriminant);
    for (const double t : {(-b - root) / a, (-b + root) / a}) {
      if (std::abs(o.z + t * d.z) <= half) offer(t, 0);
    }
  }
  for (int face = 1; face <= 2; ++face) {
    const double t = ((face == 1 ? half : -half) - o.z) / away_from_zero(d.z);
    const double x = o.x + t * d.x, y = o.y + t * d.y, r = face == 1 ? top : bottom;
    if (x * x + y * y <= r * r) offer(t, face);
  }
  return best.t < kInfinity ? best : Intersection{};
}

Intersection ellipsoid_hit(const Primitive& p, Vec3 o, Vec3 d, double near) {
  const Vec3 os{o.x / p.size.x, o.y / p.size.y, o.z / p.size.z}, ds{d.x / p.size.x, d.y / p.size.y, d.z / p.size.z};
  const double a = dot(ds, ds), b = dot(os, ds), c = dot(os, os) - 1.0;
  const double discriminant = b * b - a * c;
  if (discriminant < 0.0) return {};
  const double t = (-b - std::sqrt(discriminant)) / a;
  return t > near ? Intersection{t, 0} : Intersection{};
}

SurfacePoint on_box(const Primitive& p, Vec3 q, int face) {
  const int axis = face / 2;
  const double sign = (face % 2 == 0) ? 1.0 : -1.0;
  const double outward = p.kind == Kind::kRoom ? -sign : sign;
  // Seen from the lit side, u runs to the right and v down (on floors and table tops: u along x).
  if (axis == 0) return {{outward, 0, 0}, {0, outward, 0}, {0, 0, -1}, outward * q.y, -q.z};
  if (axis == 1) return {{0, outward, 0}, {-outward, 0, 0}, {0, 0, -1}, -outward * q.x, -q.z};
  return {{0, 0, outward}, {1, 0, 0}, {0, -outward, 0}, q.x, -outward * q.y};
}

SurfacePoint on_cone(const Primitive& p, Vec3 q, int face) {
  if (face > 0) {
    const double sign = face == 1 ? 1.0 : -1.0;
    return {{0, 0, sign}, {1, 0, 0}, {0, -sign, 0}, q.x, -sign * q.y};
  }
  const double slope = (p.size.y - p.size.x) / (2.0 * p.size.z), mean_radius = 0.5 * (p.size.x + p.size.y);
  const double r = std::max(std::sqrt(q.x * q.x + q.y * q.y), 1e-9);
  const Vec3 radial{q.x / r, q.y / r, 0.0};
  const Vec3 normal = normalized(Vec3{radial.x, radial.y, -slope});
  return {normal, {-radial.y, radial.x, 0.0}, {0, 0, -1}, polar_angle(q.y, q.x) * mean_radius, -q.z};
}

SurfacePoint on_ellipsoid(const Primitive& p, Vec3 q) {
  const Vec3 unit{q.x / p.size.x, q.y / p.size.y, q.z / p.size.z};
  const Vec3 normal = normalized(Vec3{unit.x / p.size.x, unit.y / p.size.y, unit.z / p.size.z});
  // Six patches, as on a cube: even texels without poles.
  const double ax = std::abs(unit.x), ay = std::abs(unit.y), az = std::abs(unit.z);
  if (az >= ax && az >= ay) return {normal, {1, 0, 0}, {0, 1, 0}, p.size.x * unit.x / az, p.size.y * unit.y / az};
  if (ax >= ay) return {normal, {0, 1, 0}, {0, 0, 1}, p.size.y * unit.y / ax, p.size.z * unit.z / ax};
  return {normal, {1, 0, 0}, {0, 0, 1}, p.size.x * unit.x / ay, p.size.z * unit.z / ay};
}

double box_distance(Vec3 size, Vec3 q) {
  const Vec3 e{std::abs(q.x) - size.x, std::abs(q.y) - size.y, std::abs(q.z) - size.z};
  const double inside = std::min(std::max({e.x, e.y, e.z}), 0.0);
  return norm(Vec3{std::max(e.x, 0.0), std::max(e.y, 0.0), std::max(e.z, 0.0)}) + inside;
}

}  // namespace

Intersection intersected(const Primitive& p, Vec3 origin, Vec3 direction, double near) {
  if (p.kind == Kind::kCone) return cone_hit(p, origin, direction, near);
  if (p.kind == Kind::kEllipsoid) return ellipsoid_hit(p, origin, direction, near);
  return box_hit(p, origin, direction, near);
}

SurfacePoint surface_point(const Primitive& p, Vec3 point, int face) {
  if (p.kind == Kind::kCone) return on_cone(p, point, face);
  if (p.kind == Kind::kEllipsoid) return on_ellipsoid(p, point);
  return on_box(p, point, face);
}

double signed_distance(const Primitive& p, Vec3 point_world) {
  const Vec3 q = transposed_times(p.rotation, point_world - p.centre);
  if (p.kind == Kind::kBox) return box_distance(p.size, q);
  if (p.kind == Kind::kRoom) return -box_distance(p.size, q);
  if (p.kind == Kind::kCone) {
    const double along = std::min(std::max(q.z / p.size.z, -1.0), 1.0);
    const double radius = 0.5 * (p.size.x + p.size.y) + 0.5 * (p.size.y - p.size.x) * along;
    const double side = std::sqrt(q.x * q.x + q.y * q.y) - radius, cap = std::abs(q.z) - p.size.z;
    const Vec3 beyond{std::max(side, 0.0), std::max(cap, 0.0), 0.0};
    return norm(beyond) + std::min(std::max(side, cap), 0.0);
  }
  const Vec3 unit{q.x / p.size.x, q.y / p.size.y, q.z / p.size.z};
  const Vec3 steep{unit.x / p.size.x, unit.y / p.size.y, unit.z / p.size.z};
  const double k = norm(unit);
  return k * (k - 1.0) / std::max(norm(steep), 1e-9);
}

Vec3 half_bounds(const Primitive& p) {
  Vec3 h = p.size;
  if (p.kind == Kind::kCone) h.x = h.y = std::max(p.size.x, p.size.y);
  return {dot(absolute(p.rotation.row(0)), h), dot(absolute(p.rotation.row(1)), h),
          dot(absolute(p.rotation.row(2)), h)};
}

Scene::Scene(std::vector<Primitive> primitives, std::vector<Texture> textures, std::vector<Light> lights, Rgb ambient,
             int num_threads)
    : primitives_(std::move(primitives)),
      textures_(std::move(textures)),
      lights_(std::move(lights)),
      ambient_(ambient) {
  fill_grids(num_threads);
}

void Scene::fill_grids(int num_threads) {
  Vec3 low{kInfinity, kInfinity, kInfinity}, high{-kInfinity, -kInfinity, -kInfinity};
  for (const auto& p : primitives_) {
    const Vec3 h = half_bounds(p), a = p.centre - h, b = p.centre + h;
    low = {std::min(low.x, a.x), std::min(low.y, a.y), std::min(low.z, a.z)};
    high = {std::max(high.x, b.x), std::max(high.y, b.y), std::max(high.z, b.z)};
  }
  grid_origin_ = low;
  const Vec3 extent = high - low;
  for (int i = 0; i < 3; ++i) grid_size_[i] = static_cast<int>(extent[i] / kGridStep) + 2;
  const std::size_t plane = static_cast<std::size_t>(grid_size_[0]) * grid_size_[1];
  const auto node = [&](int x, int y, int z) { return low + kGridStep * Vec3{1.0 * x, 1.0 * y, 1.0 * z}; };
  const auto index = [&](int x, int y, int z) { return z * plane + static_cast<std::size_t>(y) * grid_size_[0] + x; };
  distance_.assign(plane * grid_size_[2], static_cast<float>(kFarthest));
  parallel_for(grid_size_[2], num_threads, [&](int z) {
    for (const auto& p : primitives_) {
      // Only nodes that the primitive can be nearest to within the cap.
      const Vec3 h = half_bounds(p) + Vec3{kFarthest, kFarthest, kFarthest};
      const Vec3 first = (1.0 / kGridStep) * (p.centre - h - low), last = (1.0 / kGridStep) * (p.centre + h - low);
      if (z < first.z || z > last.z) continue;
      const int x_end = std::min(grid_size_[0], static_cast<int>(last.x) + 1);
      const int y_end = std::min(grid_size_[1], static_cast<int>(last.y) + 1);
      for (int y = static_cast<int>(std::max(first.y, 0.0)); y < y_end; ++y) {
        for (int x = static_cast<int>(std::max(first.x, 0.0)); x < x_end; ++x) {
          float& value = distance_[index(x, y, z)];
          value = std::min(value, static_cast<float>(signed_distance(p, node(x, y, z))));
        }
      }
    }
  });
  visible_.assign(plane * grid_size_[2], Rgb{});
  parallel_for(grid_size_[2], num_threads, [&](int z) {
    for (int y = 0; y < grid_size_[1]; ++y) {
      for (int x = 0; x < grid_size_[0]; ++x) visible_[index(x, y, z)] = lights_seen(node(x, y, z));
    }
  });
}

Rgb Scene::lights_seen(Vec3 point) const {
  Rgb out{};
  for (std::size_t k = 0; k < lights_.size(); ++k) {
    const Vec3 way = lights_[k].position - point;
    const double length = norm(way);
    double visible = 1.0, t = 0.08;
    while (t < length - 0.1 && visible > 0.0) {  // sphere tracing: the narrowest gap on the way sets the softness
      const double gap = interpolated(distance_, point + (t / length) * way);
      visible = std::min(visible, 0.5 + 0.5 * kShadowSharpness * gap / t);
      t += std::max(gap, 0.06);
    }
    out[k] = static_cast<float>(std::max(visible, 0.0));
  }
  return out;
}

template <class Value>
Value Scene::interpolated(const std::vector<Value>& grid, Vec3 point) const {
  int base[3];
  float w[3];
  const Vec3 offset = (1.0 / kGridStep) * (point - grid_origin_);
  for (int i = 0; i < 3; ++i) {
    const double limit = static_cast<double>(grid_size_[i]) - 1.001;
    const double position = std::min(std::max(offset[i], 0.0), limit);
    base[i] = static_cast<int>(position);
    w[i] = static_cast<float>(position - base[i]);
  }
  const std::size_t row = grid_size_[0], plane = row * grid_size_[1];
  const Value* g = &grid[base[2] * plane + base[1] * row + base[0]];
  const auto along_x = [&](std::size_t at) { return g[at] + (g[at + 1] - g[at]) * w[0]; };
  const auto along_y = [&](std::size_t at) {
    const Value near = along_x(at);
    return near + (along_x(at + row) - near) * w[1];
  };
  const Value low = along_y(0);
  return low + (along_y(plane) - low) * w[2];
}

double Scene::clearance_m(Vec3 point) const { return interpolated(distance_, point); }

Rgb Scene::irradiance(Vec3 point, Vec3 normal) const {
  // How much of the half space near the point is taken up by other surfaces, at three distances.
  double open = 1.0, weight = 0.34;
  for (const double reach : {0.09, 0.22, 0.5}) {
    open -= weight * std::max(reach - interpolated(distance_, point + reach * normal), 0.0) / reach;
    weight *= 0.75;
  }
  open = std::max(open, 0.15);
  Rgb sum = static_cast<float>(open * (0.85 + 0.15 * normal.z)) * ambient_;
  const Rgb visible = interpolated(visible_, point + kShadowLift * normal);
  for (std::size_t k = 0; k < lights_.size(); ++k) {
    const Vec3 way = lights_[k].position - point;
    const double squared = dot(way, way), reach = lights_[k].reach_m;
    const double facing = (dot(way, normal) / std::sqrt(squared) + 0.2) / 1.2;  // an extended light wraps a little
    if (facing <= 0.0) continue;
    const double arriving = open * facing / (1.0 + squared / (reach * reach));
    sum = sum + (static_cast<float>(arriving) * visible[k]) * lights_[k].strength;
  }
  return sum;
}

}  // namespace raycast
