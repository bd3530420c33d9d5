#include "renderer.hpp"

#include <array>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "parallel.hpp"

namespace raycast {
namespace {

constexpr int kTile = 16, kSubTile = 4;  // pixels; the primitives in view are narrowed down in two steps
constexpr double kNear = 0.01;
// A pixel's colour is the mean over a square this wide, in pixels: like a lens, and wide enough not to alias.
constexpr double kFilter = 1.4;

// A primitive as one view sees it: rays in object coordinates are origin + t * (x * right + y * down + forward).
struct Placed {
  Vec3 origin, right, down, forward;
  Vec3 centre_camera, half;      // world-aligned bounds, centre in camera coordinates
  double nearest_z, farthest_z;  // of those bounds, along the optical axis
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
    std::vector<int> all(placed_.size()), coarse, fine;
    std::iota(all.begin(), all.end(), 0);
    const int x_end = std::min(view_.width, (tile_x + 1) * kTile), y_end = std::min(view_.height, (tile_y + 1) * kTile);
    select(all, tile_x * kTile, x_end, tile_y * kTile, y_end, coarse);
    std::stable_sort(coarse.begin(), coarse.end(),
                     [&](int a, int b) { return placed_[a].nearest_z < placed_[b].nearest_z; });
    for (int y = tile_y * kTile; y < y_end; y += kSubTile) {
      for (int x = tile_x * kTile; x < x_end; x += kSubTile) {
        const int x_stop = std::min(x + kSubTile, x_end), y_stop = std::min(y + kSubTile, y_end);
        select(coarse, x, x_stop, y, y_stop, fine);
        for (int py = y; py < y_stop; ++py) {
          for (int px = x; px < x_stop; ++px) pixel(fine, px, py, out);
        }
      }
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
               0.0,
               0.0};
    const double half_depth = dot(absolute(camera.column(2)), out.half);
    out.nearest_z = out.centre_camera.z - half_depth;
    out.farthest_z = out.centre_camera.z + half_depth;
    return out;
  }

  // Place of ray i of n across the pixel, which itself reaches from 0 to 1.
  static double within(int i, int n) { return 0.5 + kFilter * ((i + 0.5) / n - 0.5); }
  double ray_x(double u) const { return (u - view_.cx) / view_.fx; }
  double ray_y(double v) const { return (v - view_.cy) / view_.fy; }

  // Those of the primitives in `from` whose bounds meet the pyramid over the pixels.
  void select(const std::vector<int>& from, int x0, int x1, int y0, int y1, std::vector<int>& found) const {
    constexpr double kMargin = 0.5 * (kFilter - 1.0);
    const Vec3 planes[4] = {{1, 0, -ray_x(x0 - kMargin)},
                            {-1, 0, ray_x(x1 + kMargin)},
                            {0, 1, -ray_y(y0 - kMargin)},
                            {0, -1, ray_y(y1 + kMargin)}};
    Vec3 widths[4];  // |component| of each plane's normal in world axes: how far bounds reach along it
    for (int k = 0; k < 4; ++k) widths[k] = absolute(view_.rotation * planes[k]);
    found.clear();
    for (const int i : from) {
      const Placed& p = placed_[i];
      bool meets = p.farthest_z > kNear;
      for (int k = 0; k < 4 && meets; ++k) meets = dot(planes[k], p.centre_camera) + dot(widths[k], p.half) >= 0.0;
      if (meets) found.push_back(i);
    }
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

  // Texture colour (0..255) seen by one of rays x rays that share a pixel.
  Rgb texture_colour(const Hit& hit, const SurfacePoint& s, double x, double y, int rays) const {
    const Placed& p = placed_[hit.primitive];
    const Surface& face = scene_.primitives()[hit.primitive].faces[hit.face];
    const Vec3 direction = x * p.right + y * p.down + p.forward;
    double along = dot(direction, s.normal);
    if (std::abs(along) < 1e-3) along = along < 0.0 ? -1e-3 : 1e-3;
    // Where the neighbouring rays meet the tangent plane, to first order.
    const auto step = [&](Vec3 axis, double focal) {
      return (kFilter * hit.t / (focal * rays)) * (axis - (dot(axis, s.normal) / along) * direction);
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

  // Colour of a pixel where faces meet. Light varies slowly: each face is lit as at its first ray.
  Rgb fine_colour(const std::vector<int>& candidates, int px, int py) const {
    constexpr int kRays = 3;
    std::array<std::pair<Hit, Rgb>, kRays * kRays> lit;
    int num_lit = 0;
    Rgb sum{};
    for (int i = 0; i < kRays * kRays; ++i) {
      const double x = ray_x(px + within(i % kRays, kRays)), y = ray_y(py + within(i / kRays, kRays));
      const Hit hit = cast(candidates, x, y);
      if (hit.primitive < 0) continue;
      const SurfacePoint s = at(hit, x, y);
      int k = 0;
      while (k < num_lit && !lit[k].first.same_face(hit)) ++k;
      if (k == num_lit) lit[num_lit++] = {hit, light(hit, s, x, y)};
      sum = sum + lit[k].second * texture_colour(hit, s, x, y, kRays);
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
      const double sx = ray_x(px + within(i % 2, 2)), sy = ray_y(py + within(i / 2, 2));
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
