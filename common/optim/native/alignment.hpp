// Normal equations of dense RGB-D alignment, and the tracking loss of Eq. 1 with its image derivatives.
// Knows nothing of Python. All images are row-major, colour channels last.
#pragma once
#include <cstddef>
#include <cstdint>

namespace vtslam {

struct Pinhole {
  float fx, fy, cx, cy;  // pixels; pixel centres at half-integers
};

// A rendered view for the colour term: what each pixel shows, and how far away it is.
struct ReferenceView {
  const float* rgb;     // [H,W,3]
  const float* depth;   // [H,W] metres, 0 where there is no surface
  const uint8_t* mask;  // [H,W], 0 leaves the pixel out
};

// Measured points for the depth term: position (3) and unit normal (3).
struct ReferencePoints {
  const float* packed;  // [M,6]
  int64_t count;
};

// One pyramid level of an observed frame: per pixel rgb (3), d/du (3), d/dv (3), depth in metres (0: none).
struct ObservedView {
  const float* packed;  // [H,W,10]
  int width, height;
  Pinhole camera;
};

struct DepthView {
  const float* depth;  // [H,W] metres, 0 where there is none
  int width, height;
  Pinhole camera;
};

struct RenderedDepth {
  const float* depth;  // [H,W] metres, already divided by alpha; 0 where the view is not covered
  int width, height;
  Pinhole camera;
};

struct AlignmentOptions {
  float color_sigma;       // residual scale of one colour channel, 0..1 units
  float color_weight;      // weight of the colour term against the depth term
  float depth_sigma_base;  // sigma(z) = base + quadratic z^2, metres
  float depth_sigma_quadratic;
  float depth_weight;
  float depth_gate_sigmas;  // pairs further apart than this many sigmas are occlusions: left out
  float border_px;          // warped pixels nearer to the image border are left out
};

struct NormalEquations {
  double H[21];  // upper triangle, row by row
  double g[6];
  double color_cost, depth_cost;  // robust costs, in squared sigmas
  int64_t color_count, depth_count;
};

// H, g and cost of a left twist xi on T_observed_reference (R row-major, t metres): Huber weights on per-channel
// colour differences and on point-to-plane distances. Rows are summed in fixed bands: any thread count, same bytes.
// The colour term runs over the pixels of `reference` and one pyramid level of the frame, the depth term over `points`
// and the frame's full depth image.
NormalEquations normal_equations(const ReferenceView& reference, const ObservedView& observed,
                                 const ReferencePoints& points, const DepthView& depth, const double R[9],
                                 const double t[3], const AlignmentOptions& options, int threads);

// Map points that a rendered view shows: inside its image, covered, and as deep as it was rendered. Writes them in the
// camera's frame to `packed` (room for all) and returns how many.
int64_t visible_points(const ReferencePoints& map, const double R[9], const double t[3], const RenderedDepth& rendered,
                       float tolerance, float* packed);

// Unit normals of every stride-th pixel of every stride-th row of a depth image, by a plane fit over a 9x9 window; zero
// where there is too little surface. A window this wide is needed: a Kinect's depth steps are as large as its pixels
// are apart.
void normals_from_depth(const float* depth, int width, int height, const Pinhole& camera, float max_relative_step,
                        int stride, float* normals);

struct TrackingLossInput {
  const float* rgb;           // rendered [H,W,3]
  const float* depth;         // rendered [H,W], accumulated
  const float* alpha;         // rendered [H,W], silhouette
  const float* target_rgb;    // [H,W,3]
  const float* target_depth;  // [H,W] metres, 0 where there is none
  const uint8_t* mask;        // [H,W], fixed part of the mask
  float silhouette_threshold, color_weight, depth_weight;
};

struct TrackingLoss {
  double color_sum, depth_sum;  // unweighted L1 sums over the mask
  int64_t count;                // pixels in the mask
};

// Eq. 1: sums of absolute differences over mask, alpha > threshold and valid depth; derivatives are weighted.
TrackingLoss tracking_loss(const TrackingLossInput& input, size_t pixels, float* d_rgb, float* d_depth);

}  // namespace vtslam
