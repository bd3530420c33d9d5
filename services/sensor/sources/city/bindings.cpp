// Python bindings: checks of shapes and values, then one call. Failures raise ValueError.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <memory>
#include <stdexcept>
#include <tuple>

#include "renderer.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

constexpr int kPlaceColumns = 8, kLookColumns = 11;

template <class T, class Shape>
using In = nb::ndarray<const T, nb::numpy, Shape, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu>;
using Kinds = In<int, nb::shape<-1>>;
using Places = In<double, nb::shape<-1, kPlaceColumns>>;
using Skins = In<int, nb::shape<-1, 3>>;
using Looks = In<double, nb::shape<-1, kLookColumns>>;

void require(bool holds, const char* text) {
  if (!holds) throw std::invalid_argument(text);
}

bool power_of_two(std::size_t n) { return n > 0 && (n & (n - 1)) == 0; }

city::Body body(int kind, const double* p, const int* skin, const double* look, int num_textures) {
  require(kind >= 0 && kind < city::kNumKinds, "kind must be 0 (box), 1 (cylinder) or 2 (ellipsoid)");
  for (int i = 0; i < kPlaceColumns; ++i) require(std::isfinite(p[i]), "places must be finite");
  require(p[4] > 0.0 && p[5] > 0.0 && p[7] > p[6], "bodies must have positive sizes");
  for (int i = 0; i < 3; ++i)
    require(skin[i] >= 0 && skin[i] < num_textures, "a skin names a texture that is not there");
  for (int i = 0; i < 6; ++i) require(look[i] > 0.0, "textures must cover a positive size");
  const raycast::Rgb tint{static_cast<float>(look[7]), static_cast<float>(look[8]), static_cast<float>(look[9]), 0.0f};
  return {static_cast<city::Kind>(kind),
          p[0],
          p[1],
          p[2],
          p[3],
          p[4],
          p[5],
          p[6],
          p[7],
          {skin[0], look[0], look[1]},
          {skin[1], look[2], look[3]},
          {skin[2], look[4], look[5]},
          look[6],
          tint,
          look[10],
          kind == 0 ? std::hypot(p[4], p[5]) : p[4]};
}

std::vector<city::Body> bodies(const Kinds& kind, const Places& place, const Skins& skin, const Looks& look,
                               int num_textures) {
  const std::size_t n = kind.shape(0);
  require(place.shape(0) == n && skin.shape(0) == n && look.shape(0) == n,
          "kind, place, skin and look must be as long");
  std::vector<city::Body> out;
  for (std::size_t i = 0; i < n; ++i) {
    out.push_back(body(kind.data()[i], place.data() + kPlaceColumns * i, skin.data() + 3 * i,
                       look.data() + kLookColumns * i, num_textures));
  }
  return out;
}

std::unique_ptr<city::Town> make_town(Kinds kind, Places place, Skins skin, Looks look,
                                      In<double, nb::shape<-1, 5>> streets,
                                      const std::vector<In<std::uint8_t, nb::shape<-1, -1, 3>>>& textures) {
  require(textures.size() >= city::kNumShared, "the first five textures are stains, asphalt, paving, grass and clouds");
  std::vector<raycast::Texture> maps;
  for (const auto& t : textures) {
    require(power_of_two(t.shape(0)) && power_of_two(t.shape(1)), "texture sizes must be powers of two");
    maps.emplace_back(t.data(), static_cast<int>(t.shape(0)), static_cast<int>(t.shape(1)));
  }
  std::vector<city::Street> lines;
  for (std::size_t i = 0; i < streets.shape(0); ++i) {
    const double* s = streets.data() + 5 * i;
    require(std::hypot(s[2] - s[0], s[3] - s[1]) > 1e-6, "a street must have a length");
    lines.push_back({s[0], s[1], s[2], s[3], s[4]});
  }
  auto standing = bodies(kind, place, skin, look, static_cast<int>(maps.size()));
  return std::make_unique<city::Town>(std::move(standing), std::move(lines), std::move(maps));
}

city::Point point(const double* m, int column) { return {m[column], -m[4 + column], m[8 + column]}; }

std::tuple<Out<std::uint8_t>, Out<double>> render(const city::Town& town, In<double, nb::shape<4, 4>> T_world_camera,
                                                  int width, int height,
                                                  std::tuple<double, double, double, double> intrinsics, Kinds kind,
                                                  Places place, Skins skin, Looks look, int num_threads) {
  require(width > 0 && height > 0, "width and height must be positive");
  const auto [fx, fy, cx, cy] = intrinsics;
  require(fx > 0.0 && fy > 0.0, "focal lengths must be positive");
  const double* m = T_world_camera.data();
  for (int i = 0; i < 12; ++i) require(std::isfinite(m[i]) && std::abs(m[i]) < 1e9, "the pose must be finite");
  const city::View view{width, height, fx, fy, cx, cy, point(m, 3), point(m, 0), point(m, 1), point(m, 2)};
  const auto moving = bodies(kind, place, skin, look, town.num_textures());
  const std::size_t h = height, w = width;
  auto rgb = std::make_unique<std::uint8_t[]>(h * w * 3);
  auto depth = std::make_unique<double[]>(h * w);
  {
    nb::gil_scoped_release release;
    city::render(town, moving, view, num_threads, {rgb.get(), depth.get()});
  }
  const auto owned = [](auto data, std::initializer_list<std::size_t> shape) {
    using T = typename decltype(data)::element_type;
    T* raw = data.release();
    return Out<T>(raw, shape, nb::capsule(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); }));
  };
  return {owned(std::move(rgb), {h, w, 3}), owned(std::move(depth), {h, w})};
}

}  // namespace

NB_MODULE(_city, m) {
  m.doc() = "Ray-cast images of a town on flat ground; the same bytes on every machine and for any number of threads.";
  nb::class_<city::Town>(m, "Town", "Houses, trees, cars and streets, found by the cell of the ground they stand in.")
      .def(nb::new_(&make_town), "kind"_a, "place"_a, "skin"_a, "look"_a, "streets"_a, "textures"_a,
           "kind int32 [N] (0 box, 1 cylinder, 2 ellipsoid); place float64 [N,8] (x, z, cosine and sine of the turn, "
           "half length along local x and z or the radius twice, heights of bottom and top; m); skin int32 [N,3] "
           "(textures of sides, ends and foot); look float64 [N,11] (width and height covered by each of them, height "
           "of the foot, tint r, g, b, shift of stains; m); streets float64 [S,5] (x0, z0, x1, z1, length of the line "
           "before; m); textures uint8 [h,w,3], powers of two, the first five stains, asphalt, paving, grass, clouds.")
      .def("render", &render, "T_world_camera"_a, "width"_a, "height"_a, "intrinsics"_a, "kind"_a, "place"_a, "skin"_a,
           "look"_a, "num_threads"_a,
           "Colour uint8 [H,W,3] and depth float64 [H,W] (m along the optical axis, 0 = nothing within 255 m) for a "
           "pose float64 [4,4] (world: x and z along the ground, y down, the ground is y = 0), (fx, fy, cx, cy) in "
           "pixels and further bodies, as in the constructor.");
}
