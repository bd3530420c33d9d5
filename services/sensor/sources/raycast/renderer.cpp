#include "renderer.hpp"

#include <limits>
#include <vector>

#include "parallel.hpp"

namespace raycast {
namespace {

constexpr int kTile = 8;  // pixels
constexpr double kNear = 0.01;

// A primitive as one view sees it: rays in object coordinates are origin + t * (x * right + y * down + forward).
struct Placed {
  Vec3 origin, right, down, forward;
  Vec3 centre_camera, half;  // world-aligned bounds, centre in camera coordinates
  double nearest_z;          // no point of the primitive is closer along the optical axis
};

struct Hit {
  double t = std::numeric_limits<double>::infinity();
  int primitive = -1;
  int face = 0;
  bool same_face(const Hit& other) const { return primitive == other.primitive && face == other.face; }
};

class Renderer {
 public:
  Renderer(const Scene& scene, const View& view) : scene_(scene), view_(view) {
    for (const auto& p : scene.primitives()) placed_.push_back(placed(p));
  }

  void tile(int tile_x, int tile_y, const Images& out) const {
    const int x_end = std::min(view_.width, (tile_x + 1) * kTile), y_end = std::min(view_.height, (tile_y + 1) * kTile);
    const auto candidates = in_tile(tile_x * kTile, x_end, tile_y * kTile, y_end);
    for (int y = tile_y * kTile; y < y_end; ++y) {
      for (int x = tile_x * kTile; x < x_end; ++x) pixel(candidates, x, y, out);
    }
  }

 private:
  Placed placed(const Primitive& p) const {
    const Mat3& camera = view_.rotation;
    const Vec3 offset = p.centre - view_.position;
    Placed out{transposed_times(p.rotation, view_.position - p.centre),
               transposed_times(p.rotation, camera.column(0)),
               transposed_times(p.rotation, camera.column(1)),
               transposed_times(p.rotation, camera.column(2)),
               transposed_times(camera, offset),
               half_bounds(p),
               0.0};
    out.nearest_z = out.centre_camera.z - reach(out, {0, 0, 1});
    return out;
  }

  // Half the length of the primitive's bounds along a direction given in camera coordinates.
  double reach(const Placed& p, Vec3 direction_camera) const {
    const Vec3 d = view_.rotation * direction_camera;
    return std::abs(d.x) * p.half.x + std::abs(d.y) * p.half.y + std::abs(d.z) * p.half.z;
  }

  double ray_x(double u) const { return (u - view_.cx) / view_.fx; }
  double ray_y(double v) const { return (v - view_.cy) / view_.fy; }

  // Primitives whose bounds meet the pyramid over the pixels, nearest first.
  std::vector<int> in_tile(int x0, int x1, int y0, int y1) const {
    const Vec3 planes[4] = {{1, 0, -ray_x(x0)}, {-1, 0, ray_x(x1)}, {0, 1, -ray_y(y0)}, {0, -1, ray_y(y1)}};
    std::vector<int> found;
    for (int i = 0; i < static_cast<int>(placed_.size()); ++i) {
      const Placed& p = placed_[i];
      bool meets = p.centre_camera.z + reach(p, {0, 0, 1}) > kNear;
      for (const Vec3& plane : planes) meets = meets && dot(plane, p.centre_camera) + reach(p, plane) >= 0.0;
      if (meets) found.push_back(i);
    }
    std::stable_sort(found.begin(), found.end(),
                     [&](int a, int b) { return placed_[a].nearest_z < placed_[b].nearest_z; });
    return found;
  }

  Hit cast(const std::vector<int>& candidates, double x, double y) const {
    Hit best;
    for (const int i : candidates) {
      const Placed& p = placed_[i];
      if (p.nearest_z > best.t) break;
      const auto hit = intersected(scene_.primitives()[i], p.origin, x * p.right + y * p.down + p.forward, kNear);
      if (hit.t > 0.0 && hit.t < best.t) best = {hit.t, i, hit.face};
    }
    return best;
  }

  SurfacePoint at(const Hit& hit, double x, double y) const {
    const Placed& p = placed_[hit.primitive];
    const Vec3 point = p.origin + hit.t * (x * p.right + y * p.down + p.forward);
    return surface_point(scene_.primitives()[hit.primitive], point, hit.face);
  }

  // Texture colour (0..255) seen by a ray that stands for 1/rays of a pixel each way.
  Rgb texture_colour(const Hit& hit, const SurfacePoint& s, double x, double y, int rays) const {
    const Placed& p = placed_[hit.primitive];
    const Surface& face = scene_.primitives()[hit.primitive].faces[hit.face];
    const Vec3 direction = x * p.right + y * p.down + p.forward;
    double along = dot(direction, s.normal);
    if (std::abs(along) < 1e-3) along = along < 0.0 ? -1e-3 : 1e-3;
    // Where the neighbouring rays meet the tangent plane, to first order.
    const auto step = [&](Vec3 axis, double focal) {
      return (hit.t / (focal * rays)) * (axis - (dot(axis, s.normal) / along) * direction);
    };
    const Vec3 dx = step(p.right, view_.fx), dy = step(p.down, view_.fy);
    const Footprint footprint{
        face.su * static_cast<float>(dot(dx, s.u_axis)), face.sv * static_cast<float>(dot(dx, s.v_axis)),
        face.su * static_cast<float>(dot(dy, s.u_axis)), face.sv * static_cast<float>(dot(dy, s.v_axis))};
    const float u = face.u0 + face.su * static_cast<float>(s.u_m), v = face.v0 + face.sv * static_cast<float>(s.v_m);
    return face.tint * scene_.texture(face.texture).sampled(u, v, footprint);
  }

  Rgb light(const Hit& hit, const SurfacePoint& s, double x, double y) const {
    const Primitive& p = scene_.primitives()[hit.primitive];
    const Vec3 ray = view_.rotation * Vec3{x, y, 1.0};
    const float glow = p.faces[hit.face].glow;
    return scene_.irradiance(view_.position + hit.t * ray, p.rotation * s.normal) + glow;
  }

  Rgb fine_colour(const std::vector<int>& candidates, int px, int py) const {
    constexpr int kRays = 4;
    Rgb sum{};
    for (int i = 0; i < kRays * kRays; ++i) {
      const double x = ray_x(px + (i % kRays + 0.5) / kRays), y = ray_y(py + (i / kRays + 0.5) / kRays);
      const Hit hit = cast(candidates, x, y);
      if (hit.primitive < 0) continue;
      const SurfacePoint s = at(hit, x, y);
      sum = sum + light(hit, s, x, y) * texture_colour(hit, s, x, y, kRays);
    }
    return (1.0f / (kRays * kRays)) * sum;
  }

  void pixel(const std::vector<int>& candidates, int px, int py, const Images& out) const {
    const std::size_t at_pixel = static_cast<std::size_t>(py) * view_.width + px;
    const double x = ray_x(px + 0.5), y = ray_y(py + 0.5);
    const Hit hit = cast(candidates, x, y);
    out.depth_m[at_pixel] = hit.primitive < 0 ? 0.0 : hit.t;
    out.cosine[at_pixel] = 0.0f;
    Rgb albedo{};
    bool one_face = hit.primitive >= 0;
    for (int i = 0; i < 4 && one_face; ++i) {
      const double sx = ray_x(px + 0.25 + 0.5 * (i % 2)), sy = ray_y(py + 0.25 + 0.5 * (i / 2));
      const Hit sub = cast(candidates, sx, sy);
      one_face = sub.same_face(hit);
      if (one_face) albedo = albedo + texture_colour(sub, at(sub, sx, sy), sx, sy, 2);
    }
    Rgb colour{};
    if (hit.primitive >= 0) {
      const SurfacePoint s = at(hit, x, y);
      const Placed& p = placed_[hit.primitive];
      const double cosine = dot(s.normal, x * p.right + y * p.down + p.forward) / std::sqrt(x * x + y * y + 1.0);
      out.cosine[at_pixel] = static_cast<float>(std::min(std::abs(cosine), 1.0));
      if (one_face) colour = 0.25f * (light(hit, s, x, y) * albedo);  // light varies too slowly to need four rays
    }
    if (!one_face) colour = fine_colour(candidates, px, py);
    const auto byte = [](float c) { return static_cast<std::uint8_t>(std::min(std::max(c, 0.0f), 255.0f) + 0.5f); };
    std::uint8_t* rgb = out.rgb + 3 * at_pixel;
    for (int i = 0; i < 3; ++i) rgb[i] = byte(colour[i]);
  }

  const Scene& scene_;
  const View& view_;
  std::vector<Placed> placed_;
};

}  // namespace

void render(const Scene& scene, const View& view, int num_threads, const Images& out) {
  const Renderer renderer(scene, view);
  const int across = (view.width + kTile - 1) / kTile, down = (view.height + kTile - 1) / kTile;
  parallel_for(down, num_threads, [&](int tile_y) {
    for (int tile_x = 0; tile_x < across; ++tile_x) renderer.tile(tile_x, tile_y, out);
  });
}

}  // namespace raycast
