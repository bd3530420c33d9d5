#include "mapping_loss.hpp"

#include <algorithm>
#include <vector>

#include "dispatch.hpp"
#include "memory.hpp"
#include "thread_pool.hpp"

namespace vtslam::native {
namespace {

constexpr std::size_t kRowsPerItem = 8;
constexpr std::size_t kAdamItem = std::size_t(1) << 15;

}  // namespace

LossTerms mapping_loss(const LossInputs& in, int threads, float* d_rgb, float* d_depth) {
  const std::size_t pixels = std::size_t(in.width) * in.height;
  const bool structural = in.ssim_share != 0.0;
  const Buffer<float> maps(structural ? 9 * pixels : 0);
  const std::size_t scratch_floats = loss_scratch_floats(in.width);
  const Buffer<float> scratch(scratch_floats * worker_count(threads));
  std::vector<LossRow> rows(in.height);
  LossArgs args{};
  args.width = in.width;
  args.height = in.height;
  args.rgb = in.rgb;
  args.depth = in.depth;
  args.target_rgb = in.target_rgb;
  args.target_depth = in.target_depth;
  args.mask = in.mask;
  args.by_mean = maps.data();
  args.by_square = maps.data() + (structural ? 3 * pixels : 0);
  args.by_product = maps.data() + (structural ? 6 * pixels : 0);
  args.d_rgb = d_rgb;
  args.d_depth = d_depth;
  args.ssim_scale = structural ? float(in.weight_color * in.ssim_share / double(3 * pixels)) : 0.0f;
  args.structural = structural;

  const Kernels& table = kernels();
  const std::size_t items = (in.height + kRowsPerItem - 1) / kRowsPerItem;
  const auto each_row = [&](auto kernel) {
    parallel_for(threads, items, [&](std::size_t item, int worker) {
      const int end = int(std::min<std::size_t>((item + 1) * kRowsPerItem, in.height));
      for (int row = int(item * kRowsPerItem); row < end; ++row) kernel(row, scratch.data() + worker * scratch_floats);
    });
  };
  each_row([&](int row, float* buffer) { table.loss_statistics_row(args, row, buffer, &rows[row]); });
  LossRow sum{};
  for (const LossRow& row : rows) {
    sum.ssim += row.ssim;
    sum.color += row.color;
    sum.depth += row.depth;
    sum.color_pixels += row.color_pixels;
    sum.depth_pixels += row.depth_pixels;
  }
  const double color_values = 3.0 * double(std::max<int64_t>(sum.color_pixels, 1));
  const double depth_values = double(std::max<int64_t>(sum.depth_pixels, 1));
  args.color_scale = float(in.weight_color * (1.0 - in.ssim_share) / color_values);
  args.depth_scale = float(in.weight_depth / depth_values);
  each_row([&](int row, float* buffer) { table.loss_gradient_row(args, row, buffer); });
  return {sum.color / color_values, structural ? sum.ssim / double(3 * pixels) : 1.0, sum.depth / depth_values};
}

void adam_step(const AdamArgs& args, size_t count, int threads) {
  const Kernels& table = kernels();
  parallel_for(threads, (count + kAdamItem - 1) / kAdamItem, [&](std::size_t item, int) {
    table.adam(args, item * kAdamItem, std::min(count, (item + 1) * kAdamItem));
  });
}

}  // namespace vtslam::native
