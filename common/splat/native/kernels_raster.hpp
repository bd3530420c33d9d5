// Per-tile kernels: blending front to back, and its derivative in the same order. A tile is cut into blocks of as
// many pixels as a vector has lanes; the state of all blocks stays in the first-level cache.
#pragma once

#include "kernels_math.hpp"
#include "types.hpp"

namespace vtslam::native {
namespace {

constexpr int kBlocksX = kTile / kBlockWidth, kBlocksY = kTile / kBlockHeight, kBlocks = kBlocksX * kBlocksY;
constexpr uint32_t kStopCheckInterval = 64;  // splats between tests whether all pixels of the tile have ended
constexpr uint32_t kPrefetchAhead = 6;

// Offsets of the lanes inside a block.
struct LaneOffsets {
  Vec column, row;
};

VTSLAM_INLINE LaneOffsets lane_offsets() {
  alignas(64) float column[kLanes], row[kLanes];
  for (int l = 0; l < kLanes; ++l) {
    column[l] = float(l % kBlockWidth);
    row[l] = float(l / kBlockWidth);
  }
  return {load(column), load(row)};
}

// A splat against a tile: the blocks it can touch and what is constant over them.
struct Footprint {
  int first_x, last_x, first_y, last_y;
  Vec column, row;  // offset of the lanes of the first block from the mean
  Vec conic_xx, conic_xy, conic_yy, log2_opacity;
};

VTSLAM_INLINE int floor_div(int a, int b) { return a < 0 ? 0 : a / b; }
VTSLAM_INLINE int smaller(int a, int b) { return a < b ? a : b; }

VTSLAM_INLINE Footprint footprint(const SplatRecord& record, int origin_x, int origin_y, const LaneOffsets& lanes) {
  Footprint f;
  f.first_x = floor_div(record.left - origin_x, kBlockWidth);
  f.last_x = smaller(record.right - origin_x, kTile - 1) / kBlockWidth;
  f.first_y = floor_div(record.top - origin_y, kBlockHeight);
  f.last_y = smaller(record.bottom - origin_y, kTile - 1) / kBlockHeight;
  // Whole numbers first: exact, and the difference that is then rounded is small.
  const float column = (float(origin_x + f.first_x * kBlockWidth) - record.column) + 0.5f;
  const float row = (float(origin_y + f.first_y * kBlockHeight) - record.row) + 0.5f;
  f.column = (lanes.column + splat(column)) - splat(record.column_fraction);
  f.row = (lanes.row + splat(row)) - splat(record.row_fraction);
  f.conic_xx = splat(record.conic_xx);
  f.conic_xy = splat(record.conic_xy);
  f.conic_yy = splat(record.conic_yy);
  f.log2_opacity = splat(record.log2_opacity);
  return f;
}

// One splat over one block: where it is blended, its weight there, and the transmittance after it.
struct Blend {
  Mask blended;  // meaningful where alpha is not zero
  Vec alpha;     // zero below alpha_min
  Vec weight, transmittance;
};

struct Limits {
  Vec alpha_cap, log2_alpha_cap, log2_alpha_min, transmittance_min;
};

VTSLAM_INLINE Limits limits_of(const Settings& settings) {
  return {splat(settings.alpha_cap), log2_of(splat(settings.alpha_cap)), log2_of(splat(settings.alpha_min)),
          splat(settings.transmittance_min)};
}

// The sign of the transmittance marks pixels that have ended: a further splat leaves it below the minimum.
VTSLAM_INLINE Blend blend(Vec log2_alpha, Vec transmittance, const Limits& limits) {
  Blend b;
  const Mask present = at_least(log2_alpha, limits.log2_alpha_min);
  b.alpha = where(present, minimum(exp2_of(maximum(log2_alpha, limits.log2_alpha_min)), limits.alpha_cap));
  const Vec next = fnma(b.alpha, transmittance, transmittance);
  b.blended = at_least(next, limits.transmittance_min);
  b.weight = where(b.blended, b.alpha * transmittance);
  b.transmittance = select(b.blended, next, negative(transmittance));
  return b;
}

VTSLAM_INLINE bool all_ended(const Vec* transmittance, int stride) {
  Vec most = transmittance[0];
  for (int b = 1; b < kBlocks; ++b) most = maximum(most, transmittance[b * stride]);
  return !any(at_least(most, splat(0.0f)));
}

VTSLAM_INLINE void prefetch(const TileArgs& tile, uint32_t q) {
  if (q + kPrefetchAhead < tile.count) __builtin_prefetch(&tile.records[tile.order[q + kPrefetchAhead]]);
}

struct TilePixels {
  int x0, y0, columns, rows;  // the part inside the image
};

VTSLAM_INLINE TilePixels tile_pixels(const TileArgs& tile) {
  const int x0 = tile.tile_x * kTile, y0 = tile.tile_y * kTile;
  return {x0, y0, smaller(kTile, tile.view.width - x0), smaller(kTile, tile.view.height - y0)};
}

VTSLAM_INLINE int block_of(int x, int y) { return (y / kBlockHeight) * kBlocksX + x / kBlockWidth; }
VTSLAM_INLINE int lane_of(int x, int y) { return (y % kBlockHeight) * kBlockWidth + x % kBlockWidth; }

// Transmittance before the first splat: one, and ended outside the image, so that a border tile can end too.
VTSLAM_INLINE void start_transmittance(const TileArgs& tile, float* channel, int block_stride) {
  const TilePixels pixels = tile_pixels(tile);
  for (int y = 0; y < kTile; ++y)
    for (int x = 0; x < kTile; ++x)
      channel[block_of(x, y) * block_stride + lane_of(x, y)] = x < pixels.columns && y < pixels.rows ? 1.0f : -1.0f;
}

VTSLAM_INLINE void write_pixels(const ForwardArgs& args, const float* state) {
  const TilePixels pixels = tile_pixels(args.tile);
  for (int y = 0; y < pixels.rows; ++y) {
    const size_t row = size_t(pixels.y0 + y) * args.tile.view.width + pixels.x0;
    for (int x = 0; x < pixels.columns; ++x) {
      const float* p = state + block_of(x, y) * kStateChannels * kLanes + lane_of(x, y);
      float* rgb = args.rgb + 3 * (row + x);
      rgb[0] = p[0];
      rgb[1] = p[kLanes];
      rgb[2] = p[2 * kLanes];
      args.depth[row + x] = p[3 * kLanes];
      args.alpha[row + x] = 1.0f - __builtin_fabsf(p[4 * kLanes]);
    }
  }
}

void forward_tile(const ForwardArgs& args) {
  const TileArgs& tile = args.tile;
  const LaneOffsets lanes = lane_offsets();
  const Limits limits = limits_of(tile.settings);
  const int origin_x = tile.tile_x * kTile, origin_y = tile.tile_y * kTile;
  Vec state[kBlocks][kStateChannels];
  for (Vec(&s)[kStateChannels] : state) s[0] = s[1] = s[2] = s[3] = splat(0.0f);
  start_transmittance(tile, reinterpret_cast<float*>(&state[0][4]), kStateChannels * kLanes);
  for (uint32_t q = 0; q < tile.count; ++q) {
    const SplatRecord& record = tile.records[tile.order[q]];
    prefetch(tile, q);
    const Footprint f = footprint(record, origin_x, origin_y, lanes);
    const Vec red = splat(record.red), green = splat(record.green), blue = splat(record.blue);
    const Vec depth = splat(record.depth);
    Vec dy = f.row;
    for (int y = f.first_y; y <= f.last_y; ++y, dy = dy + splat(float(kBlockHeight))) {
      const Vec by_x = f.conic_xy * dy, by_one = fma(f.conic_yy * dy, dy, f.log2_opacity);
      Vec dx = f.column;
      for (int x = f.first_x; x <= f.last_x; ++x, dx = dx + splat(float(kBlockWidth))) {
        Vec* s = state[y * kBlocksX + x];
        const Vec log2_alpha = fma(fma(f.conic_xx, dx, by_x), dx, by_one);
        const Blend b = blend(log2_alpha, s[4], limits);
        s[0] = fma(b.weight, red, s[0]);
        s[1] = fma(b.weight, green, s[1]);
        s[2] = fma(b.weight, blue, s[2]);
        s[3] = fma(b.weight, depth, s[3]);
        s[4] = b.transmittance;
      }
    }
    if (q % kStopCheckInterval == kStopCheckInterval - 1 && all_ended(&state[0][4], kStateChannels)) break;
  }
  for (int b = 0; b < kBlocks; ++b)
    for (int channel = 0; channel < kStateChannels; ++channel)
      store(tile.state + (b * kStateChannels + channel) * kLanes, state[b][channel]);
  write_pixels(args, tile.state);
}

// State of the backward pass per block: image derivatives (colour, depth, alpha), what the splats still to come
// contribute to the loss, and the transmittance.
enum { kByRed, kByGreen, kByBlue, kByDepth, kByAlpha, kRemaining, kTransmittance, kBackwardChannels };

// Image derivatives of the tile by block; pixels outside the image get zero. False if one is not finite.
VTSLAM_INLINE bool read_derivatives(const BackwardArgs& args, float* state) {
  const TilePixels pixels = tile_pixels(args.tile);
  uint32_t bad = 0;
  for (int i = 0; i < kBlocks * kBackwardChannels * kLanes; ++i) state[i] = 0.0f;
  for (int y = 0; y < pixels.rows; ++y) {
    const size_t row = size_t(pixels.y0 + y) * args.tile.view.width + pixels.x0;
    for (int x = 0; x < pixels.columns; ++x) {
      float* p = state + block_of(x, y) * kBackwardChannels * kLanes + lane_of(x, y);
      const float* rgb = args.d_rgb + 3 * (row + x);
      p[kByRed * kLanes] = rgb[0];
      p[kByGreen * kLanes] = rgb[1];
      p[kByBlue * kLanes] = rgb[2];
      p[kByDepth * kLanes] = args.d_depth[row + x];
      p[kByAlpha * kLanes] = args.d_alpha ? args.d_alpha[row + x] : 0.0f;
      // A product with zero is zero unless the value is infinite or NaN.
      const float zero = (rgb[0] * 0.0f + rgb[1] * 0.0f) + (rgb[2] * 0.0f + p[kByDepth * kLanes] * 0.0f);
      bad |= uint32_t(!(zero + p[kByAlpha * kLanes] * 0.0f == 0.0f));
    }
  }
  return bad == 0;
}

template <bool geometry>
VTSLAM_INLINE float* slot_of(const BackwardArgs& args, uint32_t id, const SplatRecord& record) {
  const uint32_t within = record.slot_base + uint32_t(args.tile.tile_y) * record.slot_stride + args.tile.tile_x;
  return args.slots + (size_t(args.chunk_bases[id >> args.chunk_shift]) + within) * slot_floats(geometry);
}

template <bool attributes, bool geometry, bool by_alpha>
VTSLAM_INLINE void backward_splats(const BackwardArgs& args, Vec (*state)[kBackwardChannels]) {
  const TileArgs& tile = args.tile;
  const LaneOffsets lanes = lane_offsets();
  const Limits limits = limits_of(tile.settings);
  const int origin_x = tile.tile_x * kTile, origin_y = tile.tile_y * kTile;
  const Vec zero = splat(0.0f);
  uint32_t q = 0;
  for (bool ended = false; q < tile.count && !ended; ++q) {
    const uint32_t id = tile.order[q];
    const SplatRecord& record = tile.records[id];
    prefetch(tile, q);
    const Footprint f = footprint(record, origin_x, origin_y, lanes);
    const Vec red = splat(record.red), green = splat(record.green), blue = splat(record.blue);
    const Vec depth = splat(record.depth);
    Vec sums[geometry ? kAllSums : kFewSums];
    for (Vec& sum : sums) sum = zero;
    Vec dy = f.row;
    for (int y = f.first_y; y <= f.last_y; ++y, dy = dy + splat(float(kBlockHeight))) {
      const Vec by_x = f.conic_xy * dy, by_one = fma(f.conic_yy * dy, dy, f.log2_opacity);
      Vec dx = f.column;
      for (int x = f.first_x; x <= f.last_x; ++x, dx = dx + splat(float(kBlockWidth))) {
        Vec* s = state[y * kBlocksX + x];
        const Vec log2_alpha = fma(fma(f.conic_xx, dx, by_x), dx, by_one);
        const Blend b = blend(log2_alpha, s[kTransmittance], limits);
        s[kTransmittance] = b.transmittance;
        Vec by_weight = fma(s[kByRed], red, s[kByGreen] * green) + fma(s[kByBlue], blue, s[kByDepth] * depth);
        if (by_alpha) by_weight = by_weight + s[kByAlpha];
        if (attributes) {
          sums[kSumRed] = fma(b.weight, s[kByRed], sums[kSumRed]);
          sums[kSumGreen] = fma(b.weight, s[kByGreen], sums[kSumGreen]);
          sums[kSumBlue] = fma(b.weight, s[kByBlue], sums[kSumBlue]);
        }
        if (geometry) sums[kSumDepth] = fma(b.weight, s[kByDepth], sums[kSumDepth]);
        // alpha dL/dalpha = weight by_weight - alpha / (1 - alpha) * (what comes behind)
        const Vec own = b.weight * by_weight;
        s[kRemaining] = s[kRemaining] - own;
        const Vec behind = s[kRemaining] * (b.alpha * reciprocal(splat(1.0f) - b.alpha));
        const Vec g = where(both(b.blended, at_least(limits.log2_alpha_cap, log2_alpha)), own - behind);
        const Vec gx = g * dx, gy = g * dy;
        if (attributes) {
          sums[kSumAlpha] = sums[kSumAlpha] + g;
          sums[kSumWeight] = sums[kSumWeight] + b.weight;
        }
        if (geometry) {
          sums[kSumX] = sums[kSumX] + gx;
          sums[kSumY] = sums[kSumY] + gy;
        }
        sums[kSumXX] = fma(gx, dx, sums[kSumXX]);
        sums[kSumXY] = fma(gx, dy, sums[kSumXY]);
        sums[kSumYY] = fma(gy, dy, sums[kSumYY]);
      }
    }
    store_sums(slot_of<geometry>(args, id, record), sums);
    if (q % kStopCheckInterval == kStopCheckInterval - 1)
      ended = all_ended(&state[0][kTransmittance], kBackwardChannels);
  }
  for (; q < tile.count; ++q) {
    float* slot = slot_of<geometry>(args, tile.order[q], tile.records[tile.order[q]]);
    for (int i = 0; i < slot_floats(geometry); ++i) slot[i] = 0.0f;
  }
}

template <bool attributes, bool geometry>
VTSLAM_INLINE void backward_either_alpha(const BackwardArgs& args, Vec (*state)[kBackwardChannels]) {
  if (args.d_alpha)
    backward_splats<attributes, geometry, true>(args, state);
  else
    backward_splats<attributes, geometry, false>(args, state);
}

bool backward_tile(const BackwardArgs& args) {
  Vec state[kBlocks][kBackwardChannels];
  if (!read_derivatives(args, reinterpret_cast<float*>(state))) return false;
  for (int b = 0; b < kBlocks; ++b) {
    Vec* s = state[b];
    const float* image = args.tile.state + b * kStateChannels * kLanes;
    const Vec alpha = splat(1.0f) - absolute(load(image + 4 * kLanes));
    Vec total = fma(s[kByRed], load(image), s[kByGreen] * load(image + kLanes));
    total = fma(s[kByBlue], load(image + 2 * kLanes), fma(s[kByDepth], load(image + 3 * kLanes), total));
    s[kRemaining] = fma(s[kByAlpha], alpha, total);
  }
  start_transmittance(args.tile, reinterpret_cast<float*>(&state[0][kTransmittance]), kBackwardChannels * kLanes);
  if (args.want_attributes && args.want_geometry)
    backward_either_alpha<true, true>(args, state);
  else if (args.want_attributes)
    backward_either_alpha<true, false>(args, state);
  else
    backward_either_alpha<false, true>(args, state);
  return true;
}

}  // namespace
}  // namespace vtslam::native
