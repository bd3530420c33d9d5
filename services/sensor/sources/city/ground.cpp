#include "ground.hpp"

#include <algorithm>
#include <cmath>

#include "renderer.hpp"

namespace city {
namespace {

using raycast::Footprint;
using raycast::Rgb;

constexpr double kRoad = 5.5, kKerb = 5.75, kPavement = 8.8;  // m from the middle line
constexpr double kEdgeLine = 3.6, kLineHalf = 0.07;
constexpr double kDashPeriod = 6.0, kDash = 3.0;
constexpr double kStainsAcross = 23.0;  // m covered by the stains' texture

Footprint scaled(const Footprint& f, double across) {
  const float s = static_cast<float>(1.0 / across);
  return {s * f.du_dx, s * f.dv_dx, s * f.du_dy, s * f.dv_dy};
}

// A texture coordinate brought near 0 in double: floats get coarse far from the origin.
float wrapped(double texture_units) { return static_cast<float>(texture_units - std::floor(texture_units)); }

Rgb tiled(const Town& town, int texture, double x, double z, double across, const Footprint& footprint_m) {
  return town.texture(texture).sampled(wrapped(x / across), wrapped(z / across), scaled(footprint_m, across));
}

// Share of the interval of width w around a that lies in [low, high].
double covered(double a, double w, double low, double high) {
  return std::clamp((std::min(a + 0.5 * w, high) - std::max(a - 0.5 * w, low)) / w, 0.0, 1.0);
}

// Share of the interval of width w around `along` that is painted.
double dashed(double along, double w) {
  const auto painted_before = [](double s) {
    const double whole = std::floor(s / kDashPeriod);
    return whole * kDash + std::min(s - whole * kDashPeriod, kDash);
  };
  return (painted_before(along + 0.5 * w) - painted_before(along - 0.5 * w)) / w;
}

double markings(const StreetPlace& place, double across, double along) {
  const double edge = covered(place.beside_m, across, kEdgeLine - kLineHalf, kEdgeLine + kLineHalf);
  return edge + covered(place.beside_m, across, -kLineHalf, kLineHalf) * dashed(place.along_m, along);
}

}  // namespace

float stains(const Town& town, double u_m, double v_m, const Footprint& footprint_m) {
  return 0.6f + (0.8f / 255.0f) * tiled(town, kStains, u_m, v_m, kStainsAcross, footprint_m)[0];
}

Rgb ground_colour(const Town& town, double x, double z, const GroundFootprint& f) {
  const Footprint footprint{static_cast<float>(f.dx_x), static_cast<float>(f.dx_z), static_cast<float>(f.dy_x),
                            static_cast<float>(f.dy_z)};
  const StreetPlace place = town.street_at(x, z);
  double road = 0.0, kerb = 0.0, pavement = 0.0, paint = 0.0;
  if (place.near) {
    const double along = std::max(
        std::abs(f.dx_x * place.way_x + f.dx_z * place.way_z) + std::abs(f.dy_x * place.way_x + f.dy_z * place.way_z),
        1e-3);
    const double across = std::max(
        std::abs(f.dx_z * place.way_x - f.dx_x * place.way_z) + std::abs(f.dy_z * place.way_x - f.dy_x * place.way_z),
        1e-3);
    road = covered(place.beside_m, across, -kRoad, kRoad);
    kerb = covered(place.beside_m, across, kRoad, kKerb);
    pavement = covered(place.beside_m, across, kKerb, kPavement);
    paint = road * markings(place, across, along);
  }
  const double grass = std::max(1.0 - road - kerb - pavement, 0.0);
  Rgb out{};
  if (road > 0.0) out = out + static_cast<float>(road) * tiled(town, kAsphalt, x, z, 8.3, footprint);
  if (kerb > 0.0)
    out = out + static_cast<float>(kerb) * (Rgb{40, 40, 38, 0} + tiled(town, kPaving, x, z, 3.1, footprint));
  if (pavement > 0.0) out = out + static_cast<float>(pavement) * tiled(town, kPaving, x, z, 4.7, footprint);
  if (grass > 0.0) out = out + static_cast<float>(grass) * tiled(town, kGrass, x, z, 5.9, footprint);
  const Rgb white{215, 213, 205, 0};
  out = out + static_cast<float>(0.8 * std::min(paint, 1.0)) * (white - out);
  return stains(town, x, z, footprint) * out;
}

}  // namespace city
