#include "rasterizer.hpp"

#include <algorithm>
#include <atomic>
#include <bit>
#include <cstring>
#include <vector>

#include "dispatch.hpp"
#include "thread_pool.hpp"

namespace vtslam::native {

struct Rendering {
  const Kernels* kernels;  // the state's layout is theirs
  View view;
  Settings settings;
  uint32_t count;
  int chunk_shift;
  Buffer<SplatRecord> records;
  Buffer<float> geometry;
  Buffer<TileRect> rects;
  Buffer<uint32_t> slot_starts;
  std::vector<uint32_t> chunk_bases;   // first slot of each chunk, and the number of slots
  std::vector<uint32_t> tile_offsets;  // first place of each tile in order, and the number of pairs
  Buffer<uint32_t> order;
  Buffer<float> state;

  int tiles() const { return view.tiles_x * view.tiles_y; }
  uint32_t chunks() const { return uint32_t(chunk_bases.size()) - 1; }
  uint32_t chunk_begin(std::size_t chunk) const { return uint32_t(chunk << chunk_shift); }
  uint32_t chunk_end(std::size_t chunk) const {
    return uint32_t(std::min<std::size_t>((chunk + 1) << chunk_shift, count));
  }
  Geometry geometry_arrays() const {
    float* g = geometry.data();
    return {g, g + count, g + 2 * std::size_t(count), g + 3 * std::size_t(count), g + 4 * std::size_t(count)};
  }
  TileArgs tile_args(std::size_t tile) const {
    return {view,
            settings,
            records.data(),
            order.data() + tile_offsets[tile],
            tile_offsets[tile + 1] - tile_offsets[tile],
            int(tile % view.tiles_x),
            int(tile / view.tiles_x),
            state.data() + tile * kTileStateFloats};
  }
};

namespace {

constexpr uint64_t kMostPairs = uint64_t(1) << 30;
constexpr uint32_t kMostChunks = 256;

// Depth in the upper half, index in the lower: comparing keys is comparing (depth, index).
using Key = uint64_t;

Key key_of(float depth, uint32_t id) { return Key(std::bit_cast<uint32_t>(depth)) << 32 | id; }

void insertion_sort(Key* keys, uint32_t count) {
  for (uint32_t i = 1; i < count; ++i) {
    const Key key = keys[i];
    uint32_t j = i;
    for (; j > 0 && keys[j - 1] > key; --j) keys[j] = keys[j - 1];
    keys[j] = key;
  }
}

// Sorts by all 32 bits of depth. The keys come in the order of their indices and each pass is stable, so equal depths
// stay in that order. Depths of a tile share leading bits; only the rest is sorted on. `other` is scratch.
const Key* sort_keys(Key* keys, Key* other, uint32_t count) {
  constexpr uint32_t kSmall = 32;
  if (count <= kSmall) {
    insertion_sort(keys, count);
    return keys;
  }
  uint32_t low = ~0u, high = 0;
  for (uint32_t i = 0; i < count; ++i) {
    low = std::min(low, uint32_t(keys[i] >> 32));
    high = std::max(high, uint32_t(keys[i] >> 32));
  }
  const int bits = std::bit_width(high - low);
  const int most = count < 1024 ? 8 : 11;
  const int passes = (bits + most - 1) / most;
  const int digit = passes > 0 ? (bits + passes - 1) / passes : 0;
  const uint32_t mask = (1u << digit) - 1;
  for (int pass = 0; pass < passes; ++pass) {
    uint32_t place[1 << 11] = {};
    const int shift = pass * digit;
    for (uint32_t i = 0; i < count; ++i) ++place[(uint32_t(keys[i] >> 32) - low) >> shift & mask];
    uint32_t sum = 0;
    for (uint32_t d = 0; d <= mask; ++d) sum += std::exchange(place[d], sum);
    for (uint32_t i = 0; i < count; ++i) other[place[(uint32_t(keys[i] >> 32) - low) >> shift & mask]++] = keys[i];
    std::swap(keys, other);
  }
  return keys;
}

// Projects all chunks; tile_counts gets one row of counts per chunk.
void project_all(Rendering& r, const SplatInputs& inputs, int threads, std::vector<uint32_t>& tile_counts,
                 std::vector<uint64_t>& chunk_pairs) {
  const ProjectArgs args{r.view,         r.settings,          inputs, r.records.data(), r.geometry_arrays(),
                         r.rects.data(), r.slot_starts.data()};
  std::atomic<bool> valid{true};
  parallel_for(threads, r.chunks(), [&](std::size_t chunk, int) {
    uint32_t* counts = tile_counts.data() + chunk * r.tiles();
    if (!r.kernels->project(args, r.chunk_begin(chunk), r.chunk_end(chunk), counts, &chunk_pairs[chunk])) valid = false;
  });
  if (!valid) throw BadInput("a splat array has a value that is not finite or out of range");
}

// Turns the counts into places: those of chunk c in tile t follow those of chunk c - 1, as if one thread had counted.
void lay_out(Rendering& r, std::vector<uint32_t>& tile_counts, const std::vector<uint64_t>& chunk_pairs) {
  uint64_t total = 0;
  for (uint32_t chunk = 0; chunk < r.chunks(); ++chunk) {
    r.chunk_bases[chunk] = uint32_t(total);
    total += chunk_pairs[chunk];
    if (total > kMostPairs) throw std::length_error("the scene has more than 2^30 pairs of Gaussian and 32 px tile");
  }
  r.chunk_bases.back() = uint32_t(total);
  uint32_t place = 0;
  for (int tile = 0; tile < r.tiles(); ++tile) {
    r.tile_offsets[tile] = place;
    for (uint32_t chunk = 0; chunk < r.chunks(); ++chunk)
      place += std::exchange(tile_counts[std::size_t(chunk) * r.tiles() + tile], place);
  }
  r.tile_offsets.back() = place;
}

void bin(const Rendering& r, int threads, std::vector<uint32_t>& places, Key* keys) {
  const float* depths = r.geometry_arrays().z;
  parallel_for(threads, r.chunks(), [&](std::size_t chunk, int) {
    uint32_t* place = places.data() + chunk * r.tiles();
    for (uint32_t i = r.chunk_begin(chunk); i < r.chunk_end(chunk); ++i) {
      const TileRect rect = r.rects[i];
      const Key key = key_of(depths[i], i);
      for (int y = rect.top; y <= rect.bottom; ++y)
        for (int x = rect.left; x <= rect.right; ++x) keys[place[y * r.view.tiles_x + x]++] = key;
    }
  });
}

}  // namespace

uint32_t splat_count(const Rendering& rendering) { return rendering.count; }
const View& view_of(const Rendering& rendering) { return rendering.view; }

std::shared_ptr<Rendering> render(const SplatInputs& inputs, uint32_t count, const View& view, const Settings& settings,
                                  int threads, Image& image) {
  auto rendering = std::make_shared<Rendering>();
  Rendering& r = *rendering;
  r.kernels = &kernels();
  r.view = view;
  r.settings = settings;
  r.count = count;
  r.chunk_shift = std::max(kMinChunkShift, int(std::bit_width(count / kMostChunks)));
  const uint32_t chunks = (uint64_t(count) + (uint64_t(1) << r.chunk_shift) - 1) >> r.chunk_shift;
  r.chunk_bases.assign(chunks + 1, 0);
  r.tile_offsets.assign(std::size_t(r.tiles()) + 1, 0);
  r.records = Buffer<SplatRecord>(count);
  r.geometry = Buffer<float>(5 * std::size_t(count));
  r.rects = Buffer<TileRect>(count);
  r.slot_starts = Buffer<uint32_t>(count);
  std::vector<uint32_t> places(std::size_t(chunks) * r.tiles(), 0);
  std::vector<uint64_t> chunk_pairs(chunks, 0);
  project_all(r, inputs, threads, places, chunk_pairs);
  lay_out(r, places, chunk_pairs);

  const std::size_t pixels = std::size_t(view.width) * view.height, pairs = r.tile_offsets.back();
  const Buffer<Key> keys(pairs), scratch(pairs);
  r.order = Buffer<uint32_t>(pairs);
  r.state = Buffer<float>(std::size_t(r.tiles()) * kTileStateFloats);
  image = {Buffer<float>(3 * pixels), Buffer<float>(pixels), Buffer<float>(pixels)};
  bin(r, threads, places, keys.data());
  parallel_for(threads, r.tiles(), [&](std::size_t tile, int) {
    const uint32_t first = r.tile_offsets[tile], size = r.tile_offsets[tile + 1] - first;
    const Key* sorted = sort_keys(keys.data() + first, scratch.data() + first, size);
    for (uint32_t i = 0; i < size; ++i) r.order[first + i] = uint32_t(sorted[i]);
    r.kernels->forward_tile({r.tile_args(tile), image.rgb.data(), image.depth.data(), image.alpha.data()});
  });
  return rendering;
}

void backward(const Rendering& r, const float* d_rgb, const float* d_depth, const float* d_alpha, bool want_attributes,
              bool want_geometry, int threads, GradientArrays& gradients) {
  const Buffer<float> slots(std::size_t(r.chunk_bases.back()) * slot_floats(want_geometry));
  std::atomic<bool> valid{true};
  parallel_for(threads, r.tiles(), [&](std::size_t tile, int) {
    if (!r.kernels->backward_tile({r.tile_args(tile), d_rgb, d_depth, d_alpha, r.chunk_bases.data(), r.chunk_shift,
                                   slots.data(), want_attributes, want_geometry}))
      valid = false;
  });
  if (!valid) throw BadInput("an image derivative has a value that is not finite");
  const ChainArgs args{r.view,          r.settings,           r.records.data(),     r.geometry_arrays(),
                       r.rects.data(),  r.slot_starts.data(), r.chunk_bases.data(), r.chunk_shift,
                       slots.data(),    gradients.colors,     gradients.log_radii,  gradients.opacity_logits,
                       gradients.means, gradients.weights,    want_geometry};
  struct alignas(64) Partial {
    double pose[6];
  };
  std::vector<Partial> partials(r.chunks(), Partial{});
  parallel_for(threads, r.chunks(), [&](std::size_t chunk, int) {
    r.kernels->chain(args, r.chunk_begin(chunk), r.chunk_end(chunk), partials[chunk].pose);
  });
  std::fill(gradients.pose, gradients.pose + 6, 0.0);
  for (const Partial& partial : partials)
    for (int i = 0; i < 6; ++i) gradients.pose[i] += partial.pose[i];
}

}  // namespace vtslam::native
