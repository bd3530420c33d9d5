// Plain records shared by the kernels (one copy per instruction set) and the code around them.
// Kernel files include nothing else of the project and no standard templates: an inline function compiled for
// AVX-512 could otherwise be the copy that the linker keeps for every machine.
#pragma once

#include <stddef.h>
#include <stdint.h>

namespace vtslam::native {

// Tiles are kTile x kTile pixels: the state of one (20 to 28 KB) stays in the first-level cache.
constexpr int kTile = 32;
// Gaussians are projected and binned in chunks of at least this many, so that results do not depend on threads.
constexpr int kMinChunkShift = 13;
// Floats per slot of gradient sums, one slot per (Gaussian, tile) pair: a cache line, or half of one without geometry.
constexpr int slot_floats(bool geometry) { return geometry ? 16 : 8; }
// |natural logarithm of sigma| above this is refused: its square overflows single precision twice over.
constexpr float kMaxLogRadius = 50.0f;
// A Gaussian whose image mean is further out than this (px) is dropped: a float no longer places it.
constexpr double kMaxImageCoordinate = 1e9;

// A projected Gaussian as the tile loops read it, one cache line.
// log2 alpha = log2_opacity + conic_xx dx^2 + conic_xy dx dy + conic_yy dy^2, d = pixel centre - mean.
// The mean is split into a whole and a fractional part so that offsets inside a tile are exact far from the origin.
struct alignas(64) SplatRecord {
  float column, column_fraction, row, row_fraction;
  float conic_xx, conic_xy, conic_yy, log2_opacity;
  float red, green, blue, depth;
  int16_t left, right, top, bottom;  // pixels that can reach alpha_min, inclusive
  uint32_t slot_base, slot_stride;   // slot of tile (x, y): chunk base + slot_base + y * slot_stride + x
};
static_assert(sizeof(SplatRecord) == 64);

// Tiles that a Gaussian touches, inclusive; empty if left > right.
struct TileRect {
  uint16_t left, right, top, bottom;
};

struct View {
  double rotation[9], translation[3];  // map to camera, row major
  double fx, fy, cx, cy;
  int width, height, tiles_x, tiles_y;
};

struct Settings {
  float low_pass, near_m, alpha_cap, alpha_min, transmittance_min;
};

// What the chain rule needs of each Gaussian, one array per quantity.
struct Geometry {
  float *x, *y, *z, *sigma, *opacity_complement;
};

struct SplatInputs {
  const float *means, *colors, *log_radii, *opacity_logits;
};

struct ProjectArgs {
  View view;
  Settings settings;
  SplatInputs inputs;
  SplatRecord* records;
  Geometry geometry;
  TileRect* rects;
  uint32_t* slot_starts;  // within the chunk
};

struct TileArgs {
  View view;
  Settings settings;
  const SplatRecord* records;
  const uint32_t* order;  // of this tile, front to back
  uint32_t count;
  int tile_x, tile_y;
  float* state;  // kTileStateFloats, kept from forward to backward in the kernel's own layout
};

// Red, green, blue, depth and transmittance (negative where the pixel has ended) of each pixel.
constexpr int kStateChannels = 5;
constexpr int kTileStateFloats = kStateChannels * kTile * kTile;

struct ForwardArgs {
  TileArgs tile;
  float *rgb, *depth, *alpha;
};

struct BackwardArgs {
  TileArgs tile;
  const float *d_rgb, *d_depth, *d_alpha;  // d_alpha may be null
  const uint32_t* chunk_bases;
  int chunk_shift;
  float* slots;
  bool want_attributes, want_geometry;
};

struct ChainArgs {
  View view;
  Settings settings;
  const SplatRecord* records;
  Geometry geometry;
  const TileRect* rects;
  const uint32_t *slot_starts, *chunk_bases;
  int chunk_shift;
  const float* slots;
  // Null where not wanted; the first three together, and weights only with them.
  float *d_colors, *d_log_radii, *d_opacity_logits, *d_means, *weights;
  bool want_geometry;  // pose or means
};

struct LossArgs {
  int width, height;
  const float *rgb, *depth, *target_rgb, *target_depth;
  const uint8_t* mask;  // null: all pixels count
  // Derivatives of the SSIM map: by mean, by mean of squares, by mean of products; [H, 3 W] each.
  float *by_mean, *by_square, *by_product;
  float *d_rgb, *d_depth;
  float ssim_scale, color_scale, depth_scale;  // what one value contributes to the loss
  bool structural;                             // whether there is an SSIM term
};

// Sums of one image row.
struct LossRow {
  double ssim, color, depth;
  int64_t color_pixels, depth_pixels;
};

struct AdamArgs {
  float *parameters, *m, *v;
  const float* gradients;
  float step_size, beta1, beta2, beta1_complement, beta2_complement, eps, inverse_root_bias2;
};

// One entry per operation; each instruction set provides a table.
struct Kernels {
  const char* name;
  // Projects Gaussians [begin, end), counts their tiles; false if an input is not finite or out of range.
  bool (*project)(const ProjectArgs&, uint32_t begin, uint32_t end, uint32_t* tile_counts, uint64_t* pairs);
  void (*forward_tile)(const ForwardArgs&);
  // Fills the slots of the tile's pairs; false if an image derivative is not finite.
  bool (*backward_tile)(const BackwardArgs&);
  // Chain rule for Gaussians [begin, end); adds to pose[6].
  void (*chain)(const ChainArgs&, uint32_t begin, uint32_t end, double* pose);
  // First pass of the loss over one image row; scratch holds loss_scratch_floats(width) floats.
  void (*loss_statistics_row)(const LossArgs&, int row, float* scratch, LossRow* sums);
  void (*loss_gradient_row)(const LossArgs&, int row, float* scratch);
  void (*adam)(const AdamArgs&, size_t begin, size_t end);
};

constexpr int kSsimRadius = 5;
constexpr int kSsimPad = 3 * kSsimRadius;  // floats either side of an interleaved row

// Length of one padded row buffer, and of the scratch of five of them (multiples of 16 floats).
constexpr size_t loss_row_floats(int width) { return (size_t(3) * width + 2 * kSsimPad + 16 + 16 + 15) / 16 * 16; }
constexpr size_t loss_scratch_floats(int width) { return 5 * loss_row_floats(width); }

}  // namespace vtslam::native
