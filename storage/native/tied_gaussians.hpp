// Gaussians tied to pixels as one stream: which pixels have them, their depth, and whole-numbered attribute levels.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

namespace vtslam {

constexpr int kChannels = 5;  // opacity, radius, luma, two chroma

// Gaussians that show less have coarser grids: their levels, all but the opacity's, are multiples of a scale.
struct Coarseness {
  int32_t faint, fainter;  // opacity levels below which the scale doubles, and doubles again

  int32_t scale(int32_t opacity_level) const { return 1 << ((opacity_level < faint) + (opacity_level < fainter)); }
};

// Frames one after another. In a frame the `whole` Gaussians (sub-pixel 0) come first, by pixel, then the `quarters`
// (1 to 4), by pixel and sub-pixel.
struct TiedGaussians {
  int64_t frames, height, width;
  const uint32_t* counts;     // [frames, 2]: whole, quarters
  const int32_t* view_of;     // [frames]: the frame's depth image, or -1
  const int32_t* view_ranks;  // [views, height, width]: places in the list of depths, 0 for no depth
  int32_t largest_rank;
  Coarseness coarseness;
};

// What is coded, [N] or [N, kChannels]; written to by the decoder.
template <typename Pixel, typename Subpixel, typename Level>
struct GaussianColumns {
  Pixel* pixel;
  Subpixel* subpixel;
  Level* rank;
  Level* levels;
};
using GaussiansIn = GaussianColumns<const int32_t, const uint8_t, const int32_t>;
using GaussiansOut = GaussianColumns<int32_t, uint8_t, int32_t>;

// Both throw std::invalid_argument if the columns, or the bytes, break the rules above.
std::vector<uint8_t> encode_gaussians(const TiedGaussians& ties, const GaussiansIn& columns);
void decode_gaussians(std::span<const uint8_t> bytes, const TiedGaussians& ties, const GaussiansOut& columns);

}  // namespace vtslam
