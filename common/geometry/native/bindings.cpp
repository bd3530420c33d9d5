// Python bindings of points tied to pixels: shapes checked, GIL released, one call.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <tuple>

#include "tied_points.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T, int Dims>
using In = nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu, nb::ndim<Dims>>;
using Out = nb::ndarray<float, nb::numpy, nb::c_contig, nb::device::cpu, nb::ndim<2>>;
using Intrinsics = std::tuple<double, double, double, double>;

Out tied_points(In<uint16_t, 1> frame_index, In<int32_t, 1> pixel, In<uint8_t, 1> subpixel, In<uint16_t, 1> depth,
                In<double, 3> poses, In<float, 2> offsets_px, int width, Intrinsics camera, double depth_unit_m) {
  const size_t count = pixel.shape(0);
  if (frame_index.shape(0) != count || subpixel.shape(0) != count || depth.shape(0) != count) {
    throw nb::value_error("ties: columns of different lengths");
  }
  if (poses.shape(1) != 4 || poses.shape(2) != 4) throw nb::value_error("poses: wrong shape");
  if (offsets_px.shape(1) != 2) throw nb::value_error("offsets_px: wrong shape");
  if (width < 1) throw nb::value_error("width: not positive");
  const vtslam::Ties ties{frame_index.data(), pixel.data(), subpixel.data(), depth.data(), count};
  const vtslam::TieTables tables{poses.data(), poses.shape(0), offsets_px.data(), offsets_px.shape(0)};
  const auto [fx, fy, cx, cy] = camera;
  float* points = new float[3 * count];
  nb::capsule owner(points, [](void* p) noexcept { delete[] static_cast<float*>(p); });
  bool known;
  {
    nb::gil_scoped_release release;
    known = vtslam::tied_points(ties, tables, {width, fx, fy, cx, cy}, depth_unit_m, points);
  }
  if (!known) throw nb::index_error("ties: of a frame or subpixel that is not there");
  return Out(points, {count, 3}, owner);
}

}  // namespace

NB_MODULE(_points, m) {
  m.doc() = "Points tied to pixels of posed depth images.";
  m.def("tied_points", &tied_points, "frame_index"_a, "pixel"_a, "subpixel"_a, "depth"_a, "poses"_a, "offsets_px"_a,
        "width"_a, "camera"_a, "depth_unit_m"_a, "Positions [N,3] (m) in the poses' common coordinates.");
}
