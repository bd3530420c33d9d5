// Python bindings: checks of shapes and values, then one call. Failures raise ValueError.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <stdexcept>
#include <string>
#include <tuple>

#include "noise.hpp"
#include "renderer.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T, class Shape>
using In = nb::ndarray<const T, nb::numpy, Shape, nb::c_contig, nb::device::cpu>;
template <class T>
using Out = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu>;

template <class T>
Out<T> owned(std::unique_ptr<T[]> data, std::initializer_list<std::size_t> shape) {
  T* raw = data.release();
  return Out<T>(raw, shape, nb::capsule(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); }));
}

void require(bool holds, const char* text) {
  if (!holds) throw std::invalid_argument(text);
}

raycast::Vec3 vec3(const double* p) { return {p[0], p[1], p[2]}; }

raycast::Mat3 mat3(const double* p) {
  raycast::Mat3 out;
  std::copy(p, p + 9, out.m);
  return out;
}

bool power_of_two(std::size_t n) { return n > 0 && (n & (n - 1)) == 0; }

raycast::Primitive primitive(int kind, const double* centre, const double* rotation, const double* size,
                             const int* textures, const float* faces, int num_textures) {
  require(kind >= 0 && kind <= 3, "kind must be 0 (box), 1 (room), 2 (cone) or 3 (ellipsoid)");
  raycast::Primitive out{static_cast<raycast::Kind>(kind), vec3(centre), mat3(rotation), vec3(size), {}};
  for (int i = 0; i < 6; ++i) {
    require(textures[i] >= 0 && textures[i] < num_textures, "a face names a texture that does not exist");
    const float* f = faces + 8 * i;
    out.faces[i] = {textures[i], f[0], f[1], f[2], f[3], raycast::Rgb{f[4], f[5], f[6], 0.0f}, f[7]};
  }
  return out;
}

std::unique_ptr<raycast::Scene> make_scene(In<int, nb::shape<-1>> kind, In<double, nb::shape<-1, 3>> centre,
                                           In<double, nb::shape<-1, 3, 3>> rotation, In<double, nb::shape<-1, 3>> size,
                                           In<int, nb::shape<-1, 6>> face_texture, In<float, nb::shape<-1, 6, 8>> face,
                                           const std::vector<In<std::uint8_t, nb::shape<-1, -1, 3>>>& textures,
                                           In<double, nb::shape<-1, 7>> lights, In<float, nb::shape<3>> ambient,
                                           int num_threads) {
  const std::size_t n = kind.shape(0);
  require(n > 0 && centre.shape(0) == n && rotation.shape(0) == n && size.shape(0) == n && face_texture.shape(0) == n &&
              face.shape(0) == n,
          "kind, centre, rotation, size, face_texture and face must have the same length, at least 1");
  std::vector<raycast::Texture> maps;
  for (const auto& t : textures) {
    require(power_of_two(t.shape(0)) && power_of_two(t.shape(1)), "texture sizes must be powers of two");
    maps.emplace_back(t.data(), static_cast<int>(t.shape(0)), static_cast<int>(t.shape(1)));
  }
  std::vector<raycast::Primitive> primitives;
  for (std::size_t i = 0; i < n; ++i) {
    primitives.push_back(primitive(kind.data()[i], centre.data() + 3 * i, rotation.data() + 9 * i, size.data() + 3 * i,
                                   face_texture.data() + 6 * i, face.data() + 48 * i, static_cast<int>(maps.size())));
  }
  require(lights.shape(0) <= raycast::kMaxLights, "there may be at most 4 lights");
  std::vector<raycast::Light> lamps;
  for (std::size_t i = 0; i < lights.shape(0); ++i) {
    const double* l = lights.data() + 7 * i;
    lamps.push_back({vec3(l), raycast::Rgb{float(l[3]), float(l[4]), float(l[5]), 0.0f}, l[6]});
  }
  const float* a = ambient.data();
  const raycast::Rgb everywhere{a[0], a[1], a[2], 0.0f};
  nb::gil_scoped_release release;
  return std::make_unique<raycast::Scene>(std::move(primitives), std::move(maps), std::move(lamps), everywhere,
                                          num_threads);
}

std::tuple<Out<std::uint8_t>, Out<double>, Out<float>> render(const raycast::Scene& scene,
                                                              In<double, nb::shape<4, 4>> T_world_camera, int width,
                                                              int height, std::tuple<double, double, double, double> k,
                                                              int num_threads) {
  require(width > 0 && height > 0, "width and height must be positive");
  const auto [fx, fy, cx, cy] = k;
  require(fx > 0.0 && fy > 0.0, "focal lengths must be positive");
  const double* m = T_world_camera.data();
  raycast::View view{width, height, fx, fy, cx, cy, {}, {m[3], m[7], m[11]}};
  for (int i = 0; i < 9; ++i) view.rotation.m[i] = m[4 * (i / 3) + i % 3];
  const std::size_t h = height, w = width;
  auto rgb = std::make_unique<std::uint8_t[]>(h * w * 3);
  auto depth = std::make_unique<double[]>(h * w);
  auto cosine = std::make_unique<float[]>(h * w);
  {
    nb::gil_scoped_release release;
    raycast::render(scene, view, num_threads, {rgb.get(), depth.get(), cosine.get()});
  }
  return {owned(std::move(rgb), {h, w, 3}), owned(std::move(depth), {h, w}), owned(std::move(cosine), {h, w})};
}

Out<float> fractal_noise(int height, int width, int cells_y, int cells_x, int octaves, float gain, std::uint32_t seed,
                         int num_threads) {
  require(height > 0 && width > 0 && cells_y > 0 && cells_x > 0, "sizes and cells must be positive");
  auto out = std::make_unique<float[]>(static_cast<std::size_t>(height) * width);
  {
    nb::gil_scoped_release release;
    raycast::fractal_noise({height, width, cells_y, cells_x, octaves, gain, seed}, num_threads, out.get());
  }
  return owned(std::move(out), {static_cast<std::size_t>(height), static_cast<std::size_t>(width)});
}

}  // namespace

NB_MODULE(_raycast, m) {
  m.doc() = "Ray-cast images of procedural scenes; the same bytes on every machine and for any number of threads.";
  nb::class_<raycast::Scene>(m, "Scene", "Primitives with textured faces, lights, and the light they leave.")
      .def(nb::new_(&make_scene), "kind"_a, "centre"_a, "rotation"_a, "size"_a, "face_texture"_a, "face"_a,
           "textures"_a, "lights"_a, "ambient"_a, "num_threads"_a,
           "kind int32 [N] (0 box, 1 room, 2 cone, 3 ellipsoid); centre float64 [N,3] (m); rotation float64 [N,3,3] "
           "(object to world); size float64 [N,3] (m); face_texture int32 [N,6]; face float32 [N,6,8] (u0, v0, "
           "texture units per metre su, sv, tint r, g, b, glow); textures uint8 [h,w,3], powers of two; lights "
           "float64 [L,7] (position m, strength r, g, b, half-light distance m); ambient float32 [3].")
      .def("render", &render, "T_world_camera"_a, "width"_a, "height"_a, "intrinsics"_a, "num_threads"_a,
           "Colour uint8 [H,W,3], depth float64 [H,W] (m along the optical axis, 0 = nothing hit) and the cosine "
           "between ray and normal float32 [H,W], for a pose float64 [4,4] and (fx, fy, cx, cy) in pixels.")
      .def(
          "clearance_m",
          [](const raycast::Scene& scene, std::tuple<double, double, double> point) {
            const auto [x, y, z] = point;
            return scene.clearance_m({x, y, z});
          },
          "point"_a, "Distance (m, to about 3 cm) from a world point to the nearest surface, negative inside matter.");
  m.def("fractal_noise", &fractal_noise, "height"_a, "width"_a, "cells_y"_a, "cells_x"_a, "octaves"_a, "gain"_a,
        "seed"_a, "num_threads"_a,
        "Seamless gradient noise float32 [height,width]: octave k has (cells_y, cells_x) * 2^k cells and a standard "
        "deviation of about 0.83 gain^k; octaves finer than 2 texels per cell are left out.");
}
