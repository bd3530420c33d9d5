// Python bindings of the section coders: shapes checked, GIL released, one call.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <numeric>
#include <string>
#include <tuple>

#include "columns.hpp"
#include "depth_images.hpp"
#include "tied_gaussians.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <typename T, int Dims>
using In = nb::ndarray<const T, nb::numpy, nb::c_contig, nb::device::cpu, nb::ndim<Dims>>;
template <typename T, int Dims>
using Out = nb::ndarray<T, nb::numpy, nb::c_contig, nb::device::cpu, nb::ndim<Dims>>;

void require(bool holds, const char* what) {
  if (!holds) throw nb::value_error(what);
}

template <typename T>
Out<T, 1> filled(size_t count, auto&& fill) {
  T* data = new T[count];
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  {
    nb::gil_scoped_release released;
    fill(data);
  }
  return Out<T, 1>(data, {count}, owner);
}

std::span<const uint8_t> span_of(nb::bytes bytes) {
  return {reinterpret_cast<const uint8_t*>(bytes.c_str()), bytes.size()};
}

nb::bytes bytes_of(const std::vector<uint8_t>& data) { return nb::bytes(data.data(), data.size()); }

Out<uint8_t, 1> planes(In<uint8_t, 1> data, size_t item, size_t stride, bool join) {
  require(item && data.shape(0) % item == 0, "data: not a whole number of elements");
  const size_t count = data.shape(0) / item;
  return filled<uint8_t>(data.shape(0), [&](uint8_t* out) {
    (join ? vtslam::join_planes : vtslam::split_planes)(data.data(), out, count, item, stride);
  });
}

vtslam::ImageSize image_size(std::tuple<int64_t, int64_t, int64_t> shape) {
  const auto [images, height, width] = shape;
  require(images >= 0 && height >= 0 && width >= 0, "shape: a size is negative");
  return {images, height, width};
}

using Scales = std::tuple<int32_t, int32_t>;  // vtslam::Coarseness

vtslam::TiedGaussians ties_of(std::tuple<int64_t, int64_t> size, In<uint32_t, 2> counts, In<int32_t, 1> view_of,
                              In<int32_t, 3> view_ranks, int32_t largest_rank, Scales scales) {
  const auto [height, width] = size;
  const int64_t frames = static_cast<int64_t>(counts.shape(0)), views = static_cast<int64_t>(view_ranks.shape(0));
  require(height > 0 && width > 0 && width < 65536 && height < 65536, "size: expected 1 to 65535 pixels each way");
  require(counts.shape(1) == 2 && view_of.shape(0) == counts.shape(0), "counts, view_of: wrong shape");
  require(!views || (static_cast<int64_t>(view_ranks.shape(1)) == height &&
                     static_cast<int64_t>(view_ranks.shape(2)) == width),
          "view_ranks: wrong shape");
  for (int64_t frame = 0; frame < frames; ++frame) {
    require(view_of.data()[frame] >= -1 && view_of.data()[frame] < views, "view_of: no such view");
  }
  const auto [faint, fainter] = scales;
  return {frames, height, width, counts.data(), view_of.data(), view_ranks.data(), largest_rank, {faint, fainter}};
}

size_t total(In<uint32_t, 2> counts) {
  return std::accumulate(counts.data(), counts.data() + counts.size(), size_t{0});
}

using Decoded = std::tuple<Out<int32_t, 1>, Out<uint8_t, 1>, Out<int32_t, 1>, Out<int32_t, 1>>;

}  // namespace

NB_MODULE(_coder, m) {
  m.doc() = "Coders of section files.";
  m.def(
      "split_planes", [](In<uint8_t, 1> data, size_t item, size_t stride) { return planes(data, item, stride, false); },
      "data"_a, "item"_a, "stride"_a,
      "Bytes uint8 [n*item] grouped by significance; with a stride, of folded differences to that element before.");
  m.def(
      "join_planes", [](In<uint8_t, 1> data, size_t item, size_t stride) { return planes(data, item, stride, true); },
      "data"_a, "item"_a, "stride"_a, "What split_planes was given.");
  m.def(
      "quantise",
      [](In<float, 1> values, float low, float step) {
        return filled<uint16_t>(
            values.shape(0), [&](uint16_t* out) { vtslam::quantise(values.data(), out, values.shape(0), low, step); });
      },
      "values"_a, "low"_a, "step"_a, "round((values - low) / step), each of which must lie in 0 to 65535.");
  m.def(
      "dequantise",
      [](In<uint16_t, 1> levels, float low, float step) {
        return filled<float>(levels.shape(0),
                             [&](float* out) { vtslam::dequantise(levels.data(), out, levels.shape(0), low, step); });
      },
      "levels"_a, "low"_a, "step"_a, "low + step * levels.");
  m.def(
      "encode_depth_images",
      [](In<int32_t, 3> ranks, int32_t largest) {
        std::vector<uint8_t> out;
        {
          nb::gil_scoped_release released;
          out = vtslam::encode_depth_images(ranks.data(), image_size({ranks.shape(0), ranks.shape(1), ranks.shape(2)}),
                                            largest);
        }
        return bytes_of(out);
      },
      "ranks"_a, "largest"_a, "Images int32 [V,H,W] of places 0 (no depth) to ``largest`` in a list, without loss.");
  m.def(
      "decode_depth_images",
      [](nb::bytes data, std::tuple<int64_t, int64_t, int64_t> shape, int32_t largest) {
        const vtslam::ImageSize size = image_size(shape);
        return filled<int32_t>(static_cast<size_t>(size.images * size.height * size.width),
                               [&](int32_t* out) { vtslam::decode_depth_images(span_of(data), out, size, largest); });
      },
      "data"_a, "shape"_a, "largest"_a, "The images, flat; ValueError if the bytes are not theirs.");
  m.def(
      "encode_gaussians",
      [](std::tuple<int64_t, int64_t> size, In<uint32_t, 2> counts, In<int32_t, 1> view_of, In<int32_t, 3> view_ranks,
         int32_t largest_rank, Scales scales, In<int32_t, 1> pixel, In<uint8_t, 1> subpixel, In<int32_t, 1> rank,
         In<int32_t, 2> levels) {
        const vtslam::TiedGaussians ties = ties_of(size, counts, view_of, view_ranks, largest_rank, scales);
        const size_t count = total(counts);
        require(pixel.shape(0) == count && subpixel.shape(0) == count && rank.shape(0) == count &&
                    levels.shape(0) == count && levels.shape(1) == vtslam::kChannels,
                "columns: not as many as counted");
        std::vector<uint8_t> out;
        {
          nb::gil_scoped_release released;
          out = vtslam::encode_gaussians(ties, {pixel.data(), subpixel.data(), rank.data(), levels.data()});
        }
        return bytes_of(out);
      },
      "size"_a, "counts"_a, "view_of"_a, "view_ranks"_a, "largest_rank"_a, "scales"_a, "pixel"_a, "subpixel"_a,
      "rank"_a, "levels"_a, "Gaussians in the order of the format's section 6; ValueError if they are not.");
  m.def(
      "decode_gaussians",
      [](nb::bytes data, std::tuple<int64_t, int64_t> size, In<uint32_t, 2> counts, In<int32_t, 1> view_of,
         In<int32_t, 3> view_ranks, int32_t largest_rank, Scales scales) -> Decoded {
        const vtslam::TiedGaussians ties = ties_of(size, counts, view_of, view_ranks, largest_rank, scales);
        const size_t count = total(counts);
        vtslam::GaussiansOut out{};
        auto levels = filled<int32_t>(count * vtslam::kChannels, [&](int32_t* p) { out.levels = p; });
        auto rank = filled<int32_t>(count, [&](int32_t* p) { out.rank = p; });
        auto subpixel = filled<uint8_t>(count, [&](uint8_t* p) { out.subpixel = p; });
        auto pixel = filled<int32_t>(count, [&](int32_t* p) {
          out.pixel = p;
          vtslam::decode_gaussians(span_of(data), ties, out);
        });
        return {pixel, subpixel, rank, levels};
      },
      "data"_a, "size"_a, "counts"_a, "view_of"_a, "view_ranks"_a, "largest_rank"_a, "scales"_a,
      "Pixels, sub-pixels, places of depths, levels (flat); ValueError if the bytes are not theirs.");
}
