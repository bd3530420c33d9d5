#include "renderer.hpp"

#include <algorithm>
#include <cmath>

#include "ground.hpp"
#include "parallel.hpp"
#include "vec.hpp"

namespace city {
namespace {

using raycast::Footprint;
using raycast::Rgb;

constexpr int kRowsAtOnce = 4;
// A pixel's colour is the mean over a square this wide, in pixels: like a lens, and wide enough not to alias.
constexpr double kFilter = 1.4;
constexpr Point kSun{-0.48, 0.72, -0.50};
constexpr float kShade = 0.62f, kSunlight = 0.55f;

// Texture axes and coordinates (m from the middle, m down from the top) of a point on a body.
struct Skin {
  Point normal, u_axis, v_axis;
  double u_m, from_top_m;
};

Skin skin(const Body& b, int face, Point p) {
  const double x = b.cosine * (p.x - b.x) + b.sine * (p.z - b.z), z = b.cosine * (p.z - b.z) - b.sine * (p.x - b.x);
  const auto world = [&](double lx, double lz) {
    return Point{b.cosine * lx - b.sine * lz, 0.0, b.sine * lx + b.cosine * lz};
  };
  const Point down{0.0, -1.0, 0.0};
  if (face == kTop || face == kBottom) return {{0.0, face == kTop ? 1.0 : -1.0, 0.0}, world(1, 0), world(0, 1), x, z};
  const int side = face & 7;
  if (b.kind == Kind::kBox) {
    if (side == 0) return {world(1, 0), world(0, 1), down, z, b.high - p.h};
    if (side == 1) return {world(-1, 0), world(0, -1), down, -z, b.high - p.h};
    if (side == 2) return {world(0, 1), world(-1, 0), down, -x, b.high - p.h};
    return {world(0, -1), world(1, 0), down, x, b.high - p.h};
  }
  const double radius = std::max(std::sqrt(x * x + z * z), 1e-6);
  const Point out = world(x / radius, z / radius), around = world(-z / radius, x / radius);
  const double turned = raycast::polar_angle(z, x) * b.half_x;
  if (b.kind == Kind::kCylinder) return {out, around, down, turned, b.high - p.h};
  const double half = 0.5 * (b.high - b.low), rise = (p.h - b.low - half) / half / half,
               flat = radius / b.half_x / b.half_x;
  const double length = std::sqrt(rise * rise + flat * flat);
  const Point normal = (1.0 / length) * (flat * out + Point{0.0, rise, 0.0});
  const Point along = (1.0 / length) * (rise * out - Point{0.0, flat, 0.0});
  return {normal, around, along, turned, b.high - p.h};
}

float sunlight(Point normal) { return kShade + kSunlight * static_cast<float>(std::max(dot(normal, kSun), 0.0)); }

class Renderer {
 public:
  Renderer(const Town& town, const std::vector<Body>& moving, const View& view)
      : town_(town), moving_(moving), view_(view), hits_(static_cast<std::size_t>(view.width) * view.height) {}

  void cast_row(int y, double* depth_m) {
    for (int x = 0; x < view_.width; ++x) {
      const std::size_t i = static_cast<std::size_t>(y) * view_.width + x;
      hits_[i] = town_.cast(view_.position, ray(x + 0.5, y + 0.5), moving_);
      depth_m[i] = hits_[i].body == kNothing ? 0.0 : hits_[i].t;
    }
  }

  void colour_row(int y, std::uint8_t* rgb) const {
    const auto byte = [](float c) { return static_cast<std::uint8_t>(std::min(std::max(c, 0.0f), 255.0f) + 0.5f); };
    for (int x = 0; x < view_.width; ++x) {
      const std::size_t i = static_cast<std::size_t>(y) * view_.width + x;
      const Rgb c = on_one_face(x, y) ? colour(hits_[i], ray(x + 0.5, y + 0.5), 1) : mean_colour(x, y);
      for (int k = 0; k < 3; ++k) rgb[3 * i + k] = byte(c[k]);
    }
  }

 private:
  Point ray(double u, double v) const {
    return (u - view_.cx) / view_.fx * view_.right + (v - view_.cy) / view_.fy * view_.down + view_.forward;
  }

  bool on_one_face(int x, int y) const {
    const Hit& here = hits_[static_cast<std::size_t>(y) * view_.width + x];
    for (int dy = -1; dy <= 1; ++dy) {
      for (int dx = -1; dx <= 1; ++dx) {
        const int nx = std::clamp(x + dx, 0, view_.width - 1), ny = std::clamp(y + dy, 0, view_.height - 1);
        if (!here.same_face(hits_[static_cast<std::size_t>(ny) * view_.width + nx])) return false;
      }
    }
    return true;
  }

  Rgb mean_colour(int x, int y) const {
    constexpr int kRays = 2;
    Rgb sum{};
    for (int i = 0; i < kRays * kRays; ++i) {
      const auto within = [](int k) { return 0.5 + kFilter * ((k + 0.5) / kRays - 0.5); };
      const Point direction = ray(x + within(i % kRays), y + within(i / kRays));
      sum = sum + colour(town_.cast(view_.position, direction, moving_), direction, kRays);
    }
    return (1.0f / (kRays * kRays)) * sum;
  }

  // Colour (0..255) seen by one of rays x rays that share a pixel.
  Rgb colour(const Hit& hit, Point direction, int rays) const {
    if (hit.body == kNothing) return sky(direction);
    const Point p = view_.position + hit.t * direction;
    // Where the neighbouring rays meet the tangent plane, to first order.
    const auto step = [&](Point axis, double focal, Point normal) {
      double along = dot(direction, normal);
      if (std::abs(along) < 1e-3) along = along < 0.0 ? -1e-3 : 1e-3;
      return (kFilter * hit.t / (focal * rays)) * (axis - (dot(axis, normal) / along) * direction);
    };
    if (hit.body == kGround) {
      const Point up{0.0, 1.0, 0.0}, dx = step(view_.right, view_.fx, up), dy = step(view_.down, view_.fy, up);
      return sunlight(up) * ground_colour(town_, p.x, p.z, {dx.x, dx.z, dy.x, dy.z});
    }
    const Body& body = town_.body(hit.body, moving_);
    const Skin s = skin(body, hit.face, p);
    const Point dx = step(view_.right, view_.fx, s.normal), dy = step(view_.down, view_.fy, s.normal);
    const Footprint footprint_m{static_cast<float>(dot(dx, s.u_axis)), static_cast<float>(dot(dx, s.v_axis)),
                                static_cast<float>(dot(dy, s.u_axis)), static_cast<float>(dot(dy, s.v_axis))};
    return painted(body, hit.face, s, footprint_m) * (sunlight(s.normal) * corner_light(p.h));
  }

  // Walls are darker close to the ground.
  static float corner_light(double height) { return 0.7f + 0.3f * static_cast<float>(std::min(height, 1.2) / 1.2); }

  Rgb painted(const Body& body, int face, const Skin& s, const Footprint& f) const {
    const bool foot = face >= kFoot, across_x = (face & 7) < 2;
    const Cover& cover = foot ? body.foot : (across_x ? body.end : body.side);
    const double top = foot ? body.high - body.foot_m : 0.0;
    const float su = static_cast<float>(1.0 / cover.width_m), sv = static_cast<float>(1.0 / cover.height_m);
    const double u = 0.5 + s.u_m / cover.width_m, v = (s.from_top_m - top) / cover.height_m;
    const Footprint scaled{su * f.du_dx, sv * f.dv_dx, su * f.du_dy, sv * f.dv_dy};
    const Rgb texel = town_.texture(cover.texture).sampled(static_cast<float>(u), static_cast<float>(v), scaled);
    return stains(town_, s.u_m + body.shift, s.from_top_m + body.shift, f) * (foot ? texel : body.tint * texel);
  }

  Rgb sky(Point d) const {
    const double length = std::sqrt(dot(d, d)), rise = std::max(d.h / length, 0.0);
    const Rgb horizon{205, 214, 222, 0}, zenith{104, 148, 204, 0}, cloud{244, 244, 242, 0};
    const Rgb clear = horizon + static_cast<float>(std::min(2.0 * rise, 1.0)) * (zenith - horizon);
    if (rise < 0.03) return clear;
    const double plane = 0.18 / rise;  // texture units from the zenith on, on a layer of clouds
    const float blur = static_cast<float>(plane / (rise * view_.fx));
    const Footprint footprint{blur, 0.0f, 0.0f, blur};
    const Rgb cover = town_.texture(kClouds).sampled(static_cast<float>(d.x / length * plane),
                                                     static_cast<float>(d.z / length * plane), footprint);
    const float share = (cover[0] / 255.0f) * static_cast<float>(std::min((rise - 0.03) * 8.0, 1.0));
    return clear + share * (cloud - clear);
  }

  const Town& town_;
  const std::vector<Body>& moving_;
  const View& view_;
  std::vector<Hit> hits_;
};

}  // namespace

void render(const Town& town, const std::vector<Body>& moving, const View& view, int num_threads, const Images& out) {
  Renderer renderer(town, moving, view);
  const int bands = (view.height + kRowsAtOnce - 1) / kRowsAtOnce;
  const auto rows = [&](int band, const auto& body) {
    for (int y = band * kRowsAtOnce; y < std::min(view.height, (band + 1) * kRowsAtOnce); ++y) body(y);
  };
  raycast::parallel_for(bands, num_threads,
                        [&](int band) { rows(band, [&](int y) { renderer.cast_row(y, out.depth_m); }); });
  raycast::parallel_for(bands, num_threads,
                        [&](int band) { rows(band, [&](int y) { renderer.colour_row(y, out.rgb); }); });
}

}  // namespace city
