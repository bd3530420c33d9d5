// Python bindings of the alignment kernels: shapes checked, GIL released, one call.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <initializer_list>
#include <string>
#include <tuple>

#include "alignment.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T, int Dims>
using In = nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu, nb::ndim<Dims>>;
template <typename T, int Dims>
using Out = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu, nb::ndim<Dims>>;

template <typename A>
void require(const A& array, std::initializer_list<size_t> shape, const char* name) {
  size_t axis = 0;
  for (size_t extent : shape) {
    if (array.shape(axis++) != extent) throw nb::value_error((std::string(name) + ": wrong shape").c_str());
  }
}

template <typename T>
T* owned(size_t count, nb::capsule& owner) {
  T* data = new T[count];
  owner = nb::capsule(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return data;
}

vtslam::Pinhole pinhole(const std::tuple<float, float, float, float>& k) {
  return {std::get<0>(k), std::get<1>(k), std::get<2>(k), std::get<3>(k)};
}

using Intrinsics = std::tuple<float, float, float, float>;
using System = std::tuple<Out<double, 2>, Out<double, 1>, double, double, int64_t, int64_t>;
using Loss = std::tuple<double, double, int64_t, Out<float, 3>, Out<float, 2>>;

struct Transform {
  explicit Transform(const In<double, 2>& T) {
    require(T, {4, 4}, "transform");
    const double* m = T.data();
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) R[3 * i + j] = m[4 * i + j];
      t[i] = m[4 * i + 3];
    }
  }
  double R[9], t[3];
};

System normal_equations(In<float, 3> rgb, In<float, 2> depth, In<uint8_t, 2> mask, In<float, 3> packed,
                        Intrinsics camera, In<float, 2> points, In<float, 2> frame_depth, Intrinsics frame_camera,
                        In<double, 2> T_observed_reference, const vtslam::AlignmentOptions& options, int threads) {
  const size_t h = depth.shape(0), w = depth.shape(1);
  require(rgb, {h, w, 3}, "rgb");
  require(mask, {h, w}, "mask");
  require(packed, {h, w, 10}, "packed");
  require(points, {points.shape(0), 6}, "points");
  if (h < 2 || w < 2) throw nb::value_error("images need at least 2x2 pixels");
  const Transform T(T_observed_reference);
  const vtslam::ReferenceView reference{rgb.data(), depth.data(), mask.data()};
  const vtslam::ObservedView observed{packed.data(), static_cast<int>(w), static_cast<int>(h), pinhole(camera)};
  const vtslam::ReferencePoints surface{points.data(), static_cast<int64_t>(points.shape(0))};
  const vtslam::DepthView view{frame_depth.data(), static_cast<int>(frame_depth.shape(1)),
                               static_cast<int>(frame_depth.shape(0)), pinhole(frame_camera)};
  vtslam::NormalEquations out;
  {
    nb::gil_scoped_release release;
    out = vtslam::normal_equations(reference, observed, surface, view, T.R, T.t, options, threads);
  }
  nb::capsule h_owner, g_owner;
  double* H = owned<double>(36, h_owner);
  double* g = owned<double>(6, g_owner);
  int k = 0;
  for (int i = 0; i < 6; ++i) {
    g[i] = out.g[i];
    for (int j = i; j < 6; ++j) H[6 * i + j] = H[6 * j + i] = out.H[k++];
  }
  return System(Out<double, 2>(H, {6, 6}, h_owner), Out<double, 1>(g, {6}, g_owner), out.color_cost, out.depth_cost,
                out.color_count, out.depth_count);
}

Out<float, 2> visible_points(In<float, 2> points, In<double, 2> T_camera_map, In<float, 2> depth, Intrinsics camera,
                             float tolerance) {
  const size_t count = points.shape(0);
  require(points, {count, 6}, "points");
  const Transform T(T_camera_map);
  const vtslam::RenderedDepth view{depth.data(), static_cast<int>(depth.shape(1)), static_cast<int>(depth.shape(0)),
                                   pinhole(camera)};
  nb::capsule owner;
  float* packed = owned<float>(6 * count, owner);
  int64_t kept;
  {
    nb::gil_scoped_release release;
    kept = vtslam::visible_points({points.data(), static_cast<int64_t>(count)}, T.R, T.t, view, tolerance, packed);
  }
  return Out<float, 2>(packed, {static_cast<size_t>(kept), 6}, owner);
}

Out<float, 3> normals_from_depth(In<float, 2> depth, Intrinsics camera, float max_relative_step, int stride) {
  if (stride < 1) throw nb::value_error("stride: not positive");
  const size_t step = static_cast<size_t>(stride);
  const size_t h = (depth.shape(0) + step - 1) / step, w = (depth.shape(1) + step - 1) / step;
  nb::capsule owner;
  float* normals = owned<float>(3 * h * w, owner);
  {
    nb::gil_scoped_release release;
    vtslam::normals_from_depth(depth.data(), static_cast<int>(depth.shape(1)), static_cast<int>(depth.shape(0)),
                               pinhole(camera), max_relative_step, stride, normals);
  }
  return Out<float, 3>(normals, {h, w, 3}, owner);
}

Loss tracking_loss(In<float, 3> rgb, In<float, 2> depth, In<float, 2> alpha, In<float, 3> target_rgb,
                   In<float, 2> target_depth, In<uint8_t, 2> mask, float silhouette_threshold, float color_weight,
                   float depth_weight) {
  const size_t h = depth.shape(0), w = depth.shape(1);
  require(rgb, {h, w, 3}, "rgb");
  require(alpha, {h, w}, "alpha");
  require(target_rgb, {h, w, 3}, "target_rgb");
  require(target_depth, {h, w}, "target_depth");
  require(mask, {h, w}, "mask");
  nb::capsule rgb_owner, depth_owner;
  float* d_rgb = owned<float>(3 * h * w, rgb_owner);
  float* d_depth = owned<float>(h * w, depth_owner);
  vtslam::TrackingLoss loss;
  {
    nb::gil_scoped_release release;
    loss = vtslam::tracking_loss({rgb.data(), depth.data(), alpha.data(), target_rgb.data(), target_depth.data(),
                                  mask.data(), silhouette_threshold, color_weight, depth_weight},
                                 h * w, d_rgb, d_depth);
  }
  return Loss(loss.color_sum, loss.depth_sum, loss.count, Out<float, 3>(d_rgb, {h, w, 3}, rgb_owner),
              Out<float, 2>(d_depth, {h, w}, depth_owner));
}

}  // namespace

NB_MODULE(_align, m) {
  m.doc() = "Dense RGB-D alignment and the tracking loss.";
  nb::class_<vtslam::AlignmentOptions>(m, "AlignmentOptions")
      .def(
          "__init__",
          [](vtslam::AlignmentOptions* self, float color_sigma, float color_weight, float depth_sigma_base,
             float depth_sigma_quadratic, float depth_weight, float depth_gate_sigmas, float border_px) {
            new (self)
                vtslam::AlignmentOptions{color_sigma,  color_weight,      depth_sigma_base, depth_sigma_quadratic,
                                         depth_weight, depth_gate_sigmas, border_px};
          },
          nb::kw_only(), "color_sigma"_a, "color_weight"_a, "depth_sigma_base"_a, "depth_sigma_quadratic"_a,
          "depth_weight"_a, "depth_gate_sigmas"_a, "border_px"_a);
  m.def("normal_equations", &normal_equations, "rgb"_a, "depth"_a, "mask"_a, "packed"_a, "camera"_a, "points"_a,
        "frame_depth"_a, "frame_camera"_a, "T_observed_reference"_a, "options"_a, "threads"_a,
        "H [6,6], g [6], colour cost, depth cost, colour count, depth count.");
  m.def("visible_points", &visible_points, "points"_a, "T_camera_map"_a, "depth"_a, "camera"_a, "tolerance"_a,
        "Points [M,6] (position, normal; camera frame) that a rendered depth image shows.");
  m.def("normals_from_depth", &normals_from_depth, "depth"_a, "camera"_a, "max_relative_step"_a, "stride"_a,
        "Unit normals of every stride-th pixel and row of a depth image (m); zero where unknown.");
  m.def("tracking_loss", &tracking_loss, "rgb"_a, "depth"_a, "alpha"_a, "target_rgb"_a, "target_depth"_a, "mask"_a,
        "silhouette_threshold"_a, "color_weight"_a, "depth_weight"_a,
        "Eq. 1: colour sum, depth sum, pixel count, d_rgb [H,W,3], d_depth [H,W].");
}
