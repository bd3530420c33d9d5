// Python bindings. Arrays are checked for shape, type and layout by the Python side; here only their values are.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <optional>
#include <tuple>

#include "dispatch.hpp"
#include "mapping_loss.hpp"
#include "memory.hpp"
#include "rasterizer.hpp"
#include "thread_pool.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace vtslam::native {
namespace {

template <class T, int dimensions>
using Input = nb::ndarray<const T, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template <int dimensions>
using InOut = nb::ndarray<float, nb::ndim<dimensions>, nb::c_contig, nb::device::cpu>;
template <class T>
using Output = nb::ndarray<nb::numpy, T, nb::c_contig>;

Output<float> as_array(Buffer<float>&& buffer, std::initializer_list<std::size_t> shape) {
  float* data = buffer.release();
  nb::capsule owner(data, [](void* block) noexcept { release_block(block); });
  return Output<float>(data, shape, owner);
}

template <class Array>
void refuse_unless_finite(const char* name, const Array& array) {
  for (std::size_t i = 0; i < array.size(); ++i) {
    const float value = array.data()[i];
    if (std::isfinite(value)) continue;
    std::string index;
    std::size_t rest = i;
    for (std::size_t axis = array.ndim(); axis-- > 0; rest /= array.shape(axis))
      index = std::to_string(rest % array.shape(axis)) + (index.empty() ? "" : ", ") + index;
    throw nb::value_error(
        (std::string(name) + " must be finite, got " + std::to_string(value) + " at [" + index + "]").c_str());
  }
}

struct SplatArrays {
  Input<float, 2> means, colors;
  Input<float, 1> log_radii, opacity_logits;

  SplatInputs pointers() const { return {means.data(), colors.data(), log_radii.data(), opacity_logits.data()}; }

  [[noreturn]] void refuse() const {
    refuse_unless_finite("means_m", means);
    refuse_unless_finite("colors", colors);
    refuse_unless_finite("log_radii", log_radii);
    refuse_unless_finite("opacity_logits", opacity_logits);
    for (std::size_t i = 0; i < log_radii.size(); ++i)
      if (std::fabs(log_radii.data()[i]) > kMaxLogRadius)
        throw nb::value_error(("log_radii must be within -50..50, got " + std::to_string(log_radii.data()[i]) +
                               " at [" + std::to_string(i) + "]")
                                  .c_str());
    throw nb::value_error("a splat array changed while it was read");
  }
};

void require_length(const char* name, std::size_t got, std::size_t wanted) {
  if (got != wanted)
    throw nb::value_error(
        (std::string(name) + " has length " + std::to_string(got) + ", not " + std::to_string(wanted)).c_str());
}

void require_image(const char* name, std::size_t rows, std::size_t columns, const View& view) {
  if (rows != std::size_t(view.height) || columns != std::size_t(view.width))
    throw nb::value_error((std::string(name) + " does not have the size of the rendering").c_str());
}

View view_from(int width, int height, const std::tuple<double, double, double, double>& intrinsics,
               const Input<double, 2>& pose) {
  if (width < 1 || height < 1 || width > 16384 || height > 16384)
    throw nb::value_error("images must be 1 to 16384 pixels wide and high");
  if (pose.shape(0) != 4 || pose.shape(1) != 4) throw nb::value_error("T_camera_map must be [4, 4]");
  View view{};
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) view.rotation[3 * row + column] = pose.data()[4 * row + column];
    view.translation[row] = pose.data()[4 * row + 3];
  }
  std::tie(view.fx, view.fy, view.cx, view.cy) = intrinsics;
  view.width = width;
  view.height = height;
  view.tiles_x = (width + kTile - 1) / kTile;
  view.tiles_y = (height + kTile - 1) / kTile;
  return view;
}

// What Python holds of a rendering.
struct SavedRendering {
  std::shared_ptr<const Rendering> rendering;
};

using Rendered = std::tuple<Output<float>, Output<float>, Output<float>, SavedRendering>;

Rendered render_arrays(const Input<float, 2>& means, const Input<float, 2>& colors, const Input<float, 1>& log_radii,
                       const Input<float, 1>& opacity_logits, int width, int height,
                       const std::tuple<double, double, double, double>& intrinsics, const Input<double, 2>& pose,
                       const std::tuple<double, double, double, double, double>& constants, int threads) {
  const std::size_t count = log_radii.shape(0);
  if (count >= (std::size_t(1) << 31)) throw nb::value_error("more than 2^31 Gaussians");
  require_length("means", means.shape(0) * 3, means.size());
  require_length("means", means.shape(0), count);
  require_length("colors", colors.shape(0) * 3, colors.size());
  require_length("colors", colors.shape(0), count);
  require_length("opacity_logits", opacity_logits.shape(0), count);
  const auto [low_pass, near_m, cap, alpha_min, transmittance_min] = constants;
  const Settings settings{float(low_pass), float(near_m), float(cap), float(alpha_min), float(transmittance_min)};
  const View view = view_from(width, height, intrinsics, pose);
  const SplatArrays arrays{means, colors, log_radii, opacity_logits};
  Image image;
  std::shared_ptr<Rendering> rendering;
  bool valid = true;
  {
    const nb::gil_scoped_release release;
    try {
      rendering = render(arrays.pointers(), uint32_t(count), view, settings, threads, image);
    } catch (const BadInput&) {
      valid = false;
    }
  }
  if (!valid) arrays.refuse();
  const std::size_t rows = height, columns = width;
  return {as_array(std::move(image.rgb), {rows, columns, 3}), as_array(std::move(image.depth), {rows, columns}),
          as_array(std::move(image.alpha), {rows, columns}), SavedRendering{std::move(rendering)}};
}

// Colours, log radii, opacity logits, means, blending weights (each None where not asked for), pose.
using Pulled = std::tuple<std::optional<Output<float>>, std::optional<Output<float>>, std::optional<Output<float>>,
                          std::optional<Output<float>>, std::optional<Output<float>>, std::vector<double>>;

Pulled backward_arrays(const SavedRendering& saved, const Input<float, 3>& d_rgb, const Input<float, 2>& d_depth,
                       const std::optional<Input<float, 2>>& d_alpha, bool want_attributes, bool want_pose,
                       bool want_means, bool want_weights, int threads) {
  const Rendering* rendering = saved.rendering.get();
  const View& view = view_of(*rendering);
  require_image("d_rgb", d_rgb.shape(0), d_rgb.shape(1), view);
  require_length("a pixel of d_rgb", d_rgb.shape(2), 3);
  require_image("d_depth", d_depth.shape(0), d_depth.shape(1), view);
  if (d_alpha) require_image("d_alpha", d_alpha->shape(0), d_alpha->shape(1), view);
  const std::size_t count = splat_count(*rendering);
  Buffer<float> colors(want_attributes ? 3 * count : 0), log_radii(want_attributes ? count : 0);
  Buffer<float> opacity_logits(want_attributes ? count : 0), means(want_means ? 3 * count : 0);
  Buffer<float> weights(want_weights ? count : 0);
  GradientArrays gradients{};
  if (want_attributes) {
    gradients.colors = colors.data();
    gradients.log_radii = log_radii.data();
    gradients.opacity_logits = opacity_logits.data();
  }
  if (want_weights && !want_attributes) throw nb::value_error("weights come with the attributes' derivatives");
  if (want_means) gradients.means = means.data();
  if (want_weights) gradients.weights = weights.data();
  bool valid = true;
  {
    const nb::gil_scoped_release release;
    try {
      backward(*rendering, d_rgb.data(), d_depth.data(), d_alpha ? d_alpha->data() : nullptr, want_attributes,
               want_pose || want_means, threads, gradients);
    } catch (const BadInput&) {
      valid = false;
    }
  }
  if (!valid) {
    refuse_unless_finite("d_rgb", d_rgb);
    refuse_unless_finite("d_depth", d_depth);
    if (d_alpha) refuse_unless_finite("d_alpha", *d_alpha);
    throw nb::value_error("an image derivative changed while it was read");
  }
  Pulled out;
  if (want_attributes) {
    std::get<0>(out) = as_array(std::move(colors), {count, 3});
    std::get<1>(out) = as_array(std::move(log_radii), {count});
    std::get<2>(out) = as_array(std::move(opacity_logits), {count});
  }
  if (want_means) std::get<3>(out) = as_array(std::move(means), {count, 3});
  if (want_weights) std::get<4>(out) = as_array(std::move(weights), {count});
  if (want_pose) std::get<5>(out).assign(gradients.pose, gradients.pose + 6);
  return out;
}

// L1 of colour, SSIM, L1 of depth, d_rgb, d_depth.
using Loss = std::tuple<double, double, double, Output<float>, Output<float>>;

Loss mapping_loss_arrays(const Input<float, 3>& rgb, const Input<float, 2>& depth_m, const Input<float, 3>& target_rgb,
                         const Input<float, 2>& target_depth_m, const std::optional<Input<uint8_t, 2>>& mask,
                         double weight_color, double weight_depth, double ssim_share, int threads) {
  const std::size_t rows = rgb.shape(0), columns = rgb.shape(1);
  View size{};
  size.width = int(columns);
  size.height = int(rows);
  if (rows < 1 || columns < 1 || rows > 16384 || columns > 16384)
    throw nb::value_error("images must be 1 to 16384 pixels wide and high");
  require_length("a pixel of rgb", rgb.shape(2), 3);
  require_length("a pixel of target_rgb", target_rgb.shape(2), 3);
  require_image("target_rgb", target_rgb.shape(0), target_rgb.shape(1), size);
  require_image("depth_m", depth_m.shape(0), depth_m.shape(1), size);
  require_image("target_depth_m", target_depth_m.shape(0), target_depth_m.shape(1), size);
  if (mask) require_image("mask", mask->shape(0), mask->shape(1), size);
  Buffer<float> d_rgb(3 * rows * columns), d_depth(rows * columns);
  LossTerms terms{};
  {
    const nb::gil_scoped_release release;
    terms = mapping_loss({size.width, size.height, rgb.data(), depth_m.data(), target_rgb.data(), target_depth_m.data(),
                          mask ? mask->data() : nullptr, weight_color, weight_depth, ssim_share},
                         threads, d_rgb.data(), d_depth.data());
  }
  if (!std::isfinite(terms.color + terms.ssim + terms.depth)) {
    refuse_unless_finite("rgb", rgb);
    refuse_unless_finite("target_rgb", target_rgb);
    refuse_unless_finite("depth_m", depth_m);
    refuse_unless_finite("target_depth_m", target_depth_m);
    throw nb::value_error("the loss is not finite: the images' values are too large");
  }
  return {terms.color, terms.ssim, terms.depth, as_array(std::move(d_rgb), {rows, columns, 3}),
          as_array(std::move(d_depth), {rows, columns})};
}

void adam_arrays(const InOut<1>& parameters, const Input<float, 1>& gradients, const InOut<1>& m, const InOut<1>& v,
                 double lr, double beta1, double beta2, double eps, int step, int threads) {
  const std::size_t count = parameters.shape(0);
  require_length("gradients", gradients.shape(0), count);
  require_length("m", m.shape(0), count);
  require_length("v", v.shape(0), count);
  if (step < 1) throw nb::value_error("step counts from 1");
  AdamArgs args{};
  args.parameters = parameters.data();
  args.m = m.data();
  args.v = v.data();
  args.gradients = gradients.data();
  args.step_size = float(lr / (1.0 - std::pow(beta1, step)));
  args.beta1 = float(beta1);
  args.beta2 = float(beta2);
  args.beta1_complement = float(1.0 - beta1);
  args.beta2_complement = float(1.0 - beta2);
  args.eps = float(eps);
  args.inverse_root_bias2 = float(1.0 / std::sqrt(1.0 - std::pow(beta2, step)));
  const nb::gil_scoped_release release;
  adam_step(args, count, threads);
}

}  // namespace
}  // namespace vtslam::native

NB_MODULE(_native, m) {
  using namespace vtslam::native;
  m.doc() = "CPU rasteriser with gradients, fused mapping loss and optimiser step; see native_engine.py.";
  nb::class_<SavedRendering>(m, "SavedRendering", "What one rendering keeps for its derivative.")
      .def_prop_ro(
          "count", [](const SavedRendering& saved) { return splat_count(*saved.rendering); }, "Number of Gaussians.");
  m.def("render", &render_arrays, "means_m"_a, "colors"_a, "log_radii"_a, "opacity_logits"_a, "width"_a, "height"_a,
        "intrinsics"_a, "T_camera_map"_a, "constants"_a, "threads"_a = 0,
        "rgb, depth_m, alpha and the record for backward. intrinsics: fx, fy, cx, cy; constants: low_pass_px2, near_m, "
        "alpha_cap, alpha_min, transmittance_min; threads 0: the default.");
  m.def("backward", &backward_arrays, "saved"_a, "d_rgb"_a, "d_depth"_a, "d_alpha"_a.none(), "want_attributes"_a,
        "want_pose"_a, "want_means"_a, "want_weights"_a, "threads"_a = 0,
        "Derivatives by colours, log_radii, opacity_logits, means_m (None where not wanted) and pose (empty if not).");
  m.def("mapping_loss", &mapping_loss_arrays, "rgb"_a, "depth_m"_a, "target_rgb"_a, "target_depth_m"_a, "mask"_a.none(),
        "weight_color"_a, "weight_depth"_a, "ssim_share"_a, "threads"_a = 0,
        "Mean |colour error|, SSIM, mean |depth error|, and the loss's derivatives by rgb and depth_m.");
  m.def("adam_step", &adam_arrays, "parameters"_a, "gradients"_a, "m"_a, "v"_a, "lr"_a, "beta1"_a, "beta2"_a, "eps"_a,
        "step"_a, "threads"_a = 0, "One Adam step in place; step counts from 1.");
  m.def("simd", [] { return std::string(kernels().name); }, "Name of the instruction set in use.");
  m.def("available_simd", &available_simd, "Instruction sets that can run here, best first.");
  m.def("select_simd", &select_simd, "name"_a, "Switch to an instruction set; ValueError if it cannot run here.");
  m.def("threads", &default_threads, "Threads used where a call does not say.");
  m.def("set_threads", &set_default_threads, "threads"_a, "Set that number; 0 returns to the default.");
}
