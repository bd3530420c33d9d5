#include "depth_images.hpp"

#include <algorithm>
#include <cstdlib>
#include <memory>

#include "range_coder.hpp"

namespace vtslam {
namespace {

int bucket(int32_t size) {
  int out = 0;
  for (; size > 0 && out < 7; size >>= 1) ++out;
  return out;
}

// Causal neighbours of a pixel; 0 (no depth) beyond the border.
struct Around {
  int32_t west, north, north_west, north_east;
};

Around around(const int32_t* image, int64_t row, int64_t column, int64_t width) {
  const int32_t* at = image + row * width + column;
  return {column ? at[-1] : 0, row ? at[-width] : 0, row && column ? at[-width - 1] : 0,
          row && column + 1 < width ? at[-width + 1] : 0};
}

// Holes are told apart from depths first, then depths are predicted from those of the neighbours that have one.
class DepthModel {
 public:
  template <typename Coder>
  int32_t code(Coder& coder, const Around& n, int32_t value, int32_t largest) {
    const int holes = (n.west == 0) | (n.north == 0) << 1 | (n.north_west == 0) << 2 | (n.north_east == 0) << 3;
    if (!coder.bit(has_depth_[holes], value != 0)) return 0;
    const int32_t guess = predicted(n);
    const int spread = bucket(n.west && n.north ? std::abs(n.west - n.north) : 127);
    const int slope = bucket(n.north && n.north_east ? std::abs(n.north - n.north_east) : 3);
    const int32_t found = guess + residuals_[8 * spread + slope].code(coder, value - guess, 0);
    if (found < 1 || found > largest) throw std::invalid_argument("a depth is outside of its list");
    return found;
  }

 private:
  static int32_t predicted(const Around& n) {
    if (n.west && n.north && n.north_west) {
      const int32_t plane = n.west + n.north - n.north_west;
      return std::clamp(plane, std::min(n.west, n.north), std::max(n.west, n.north));
    }
    for (const int32_t depth : {n.west, n.north, n.north_west, n.north_east}) {
      if (depth) return depth;
    }
    return 1;
  }

  AdaptiveBit has_depth_[16];
  AdaptiveNumber residuals_[64];
};

template <typename Coder, typename Rank>
void code_images(Coder& coder, Rank* ranks, ImageSize size, int32_t largest) {
  const auto model = std::make_unique<DepthModel>();
  for (int64_t image = 0; image < size.images; ++image, ranks += size.height * size.width) {
    for (int64_t row = 0; row < size.height; ++row) {
      for (int64_t column = 0; column < size.width; ++column) {
        const int64_t at = row * size.width + column;
        const Around near = around(ranks, row, column, size.width);
        if constexpr (Coder::kDecodes) {
          ranks[at] = model->code(coder, near, 0, largest);
        } else {
          model->code(coder, near, ranks[at], largest);
        }
      }
    }
  }
}

}  // namespace

std::vector<uint8_t> encode_depth_images(const int32_t* ranks, ImageSize size, int32_t largest) {
  Encoder coder;
  code_images(coder, ranks, size, largest);
  return coder.finished();
}

void decode_depth_images(std::span<const uint8_t> bytes, int32_t* ranks, ImageSize size, int32_t largest) {
  Decoder coder(bytes);
  code_images(coder, ranks, size, largest);
  coder.finish();
}

}  // namespace vtslam
