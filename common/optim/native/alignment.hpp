// Normal equations of dense RGB-D alignment, and the tracking loss of Eq. 1 with its image derivatives.
// Knows nothing of Python. All images are row-major, colour channels last.
#pragma once
#include <cstddef>
#include <cstdint>

namespace vtslam {

struct Pinhole {
  float fx, fy, cx, cy;  // pixels; pixel centres at half-integers
};

// A rendered view, seen as a textured surface.
struct ReferenceView {
  const float* rgb;      // [H,W,3]
  const float* depth;    // [H,W] metres, 0 where there is no surface
  const float* normals;  // [H,W,3] unit, reference camera frame; zero where unknown
  const uint8_t* mask;   // [H,W], 0 leaves the pixel out
};

// An observed frame: per pixel rgb (3), d/du (3), d/dv (3), depth in metres (1; 0 where there is none).
struct ObservedView {
  const float* packed;  // [H,W,10]
};

struct AlignmentOptions {
  float color_sigma;        // residual scale of one colour channel, 0..1 units
  float color_weight;       // weight of the colour term against the depth term
  float depth_sigma_base;   // sigma(z) = base + quadratic z^2, metres
  float depth_sigma_quadratic;
  float depth_weight;
  float depth_gate_sigmas;  // pairs whose plane distance exceeds this many sigmas are occlusions: left out
  float border_px;          // warped pixels nearer to the image border are left out
};

struct NormalEquations {
  double H[21];  // upper triangle, row by row
  double g[6];
  double color_cost, depth_cost;  // robust costs, in squared sigmas
  int64_t color_count, depth_count, visible_count;
};

// H, g and cost of a left twist xi on T_observed_reference (R row-major, t metres): Huber weights on per-channel
// colour differences and on point-to-plane distances. Rows are summed in fixed bands: any thread count, same bytes.
NormalEquations normal_equations(const ReferenceView& reference, const ObservedView& observed, int width, int height,
                                 const Pinhole& camera, const double R[9], const double t[3],
                                 const AlignmentOptions& options, int threads);

// Unit normals [H,W,3] of a depth image by central differences; zero at borders, holes and depth steps.
void normals_from_depth(const float* depth, int width, int height, const Pinhole& camera, float max_relative_step,
                        float* normals);

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
