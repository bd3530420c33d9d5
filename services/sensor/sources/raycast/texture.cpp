#include "texture.hpp"

#include <algorithm>
#include <cmath>

#include "vec.hpp"

namespace raycast {
namespace {

constexpr int kMaxProbes = 3;

// The four bytes of a texel in the four 16-bit lanes of a word.
std::uint64_t spread(std::uint32_t texel) {
  std::uint64_t t = texel;
  t = (t | (t << 16)) & 0x0000ffff0000ffffull;
  return (t | (t << 8)) & 0x00ff00ff00ff00ffull;
}

int floored(float x) {
  const int i = static_cast<int>(x);
  return i - (x < static_cast<float>(i) ? 1 : 0);
}

}  // namespace

Texture::Texture(const std::uint8_t* rgb, int height, int width) {
  Level base{width, height, std::vector<std::uint32_t>(static_cast<std::size_t>(width) * height)};
  for (std::size_t i = 0; i < base.texels.size(); ++i) {
    base.texels[i] = rgb[3 * i] | (rgb[3 * i + 1] << 8) | (rgb[3 * i + 2] << 16);
  }
  levels_.push_back(std::move(base));
  while (levels_.back().width > 1 && levels_.back().height > 1) {
    const Level& fine = levels_.back();
    Level coarse{fine.width / 2, fine.height / 2, {}};
    coarse.texels.resize(static_cast<std::size_t>(coarse.width) * coarse.height);
    for (int y = 0; y < coarse.height; ++y) {
      const std::uint32_t *top = &fine.texels[static_cast<std::size_t>(2 * y) * fine.width], *bottom = top + fine.width;
      for (int x = 0; x < coarse.width; ++x) {
        const std::uint64_t sum = spread(top[2 * x]) + spread(top[2 * x + 1]) + spread(bottom[2 * x]) +
                                  spread(bottom[2 * x + 1]) + 0x0002000200020002ull;
        const std::uint64_t mean = (sum >> 2) & 0x00ff00ff00ff00ffull;
        coarse.texels[static_cast<std::size_t>(y) * coarse.width + x] =
            static_cast<std::uint32_t>((mean & 0xffu) | ((mean >> 8) & 0xff00u) | ((mean >> 16) & 0xff0000u));
      }
    }
    levels_.push_back(std::move(coarse));
  }
}

Rgb Texture::bilinear(const Level& level, float u, float v) {
  const float x = u * static_cast<float>(level.width) - 0.5f, y = v * static_cast<float>(level.height) - 0.5f;
  const int left = floored(x), above = floored(y);
  const int x0 = left & (level.width - 1), y0 = above & (level.height - 1);
  const int x1 = (x0 + 1) & (level.width - 1), y1 = (y0 + 1) & (level.height - 1);
  // Weights in 1/256, so that all channels are blended at once in 16-bit lanes; they add up to 256 exactly.
  const auto wx = static_cast<std::uint64_t>((x - static_cast<float>(left)) * 256.0f + 0.5f);
  const auto wy = static_cast<std::uint64_t>((y - static_cast<float>(above)) * 256.0f + 0.5f);
  const std::uint64_t w11 = (wx * wy + 128u) >> 8, w01 = wx - w11, w10 = wy - w11, w00 = 256u - wx - w10;
  const std::uint32_t* top = &level.texels[static_cast<std::size_t>(y0) * level.width];
  const std::uint32_t* bottom = &level.texels[static_cast<std::size_t>(y1) * level.width];
  const std::uint64_t sum =
      w00 * spread(top[x0]) + w01 * spread(top[x1]) + w10 * spread(bottom[x0]) + w11 * spread(bottom[x1]);
  const auto lane = [sum](int k) { return static_cast<float>(static_cast<int>((sum >> (16 * k)) & 0xffffu)); };
  return (1.0f / 256.0f) * Rgb{lane(0), lane(1), lane(2), 0.0f};
}

Rgb Texture::trilinear(float u, float v, float lod) const {
  const float top = static_cast<float>(levels_.size() - 1);
  const float clamped = std::min(std::max(lod, 0.0f), top);
  const int fine = static_cast<int>(clamped);
  const float weight = clamped - static_cast<float>(fine);
  const Rgb a = bilinear(levels_[fine], u, v);
  return weight > 0.0f ? a + weight * (bilinear(levels_[fine + 1], u, v) - a) : a;
}

Rgb Texture::sampled(float u, float v, const Footprint& f) const {
  const float w = static_cast<float>(levels_[0].width), h = static_cast<float>(levels_[0].height);
  const float along_x = std::sqrt(f.du_dx * f.du_dx * w * w + f.dv_dx * f.dv_dx * h * h);
  const float along_y = std::sqrt(f.du_dy * f.du_dy * w * w + f.dv_dy * f.dv_dy * h * h);
  const float longer = std::max(along_x, along_y), shorter = std::max(std::min(along_x, along_y), 1e-6f);
  const int probes = std::min(kMaxProbes, static_cast<int>(std::min(longer / shorter, 1e6f) + 0.4f));
  const float lod = coarse_log2(std::max(longer / static_cast<float>(probes), 1e-6f));
  if (probes <= 1) return trilinear(u, v, lod);
  const float du = along_x >= along_y ? f.du_dx : f.du_dy, dv = along_x >= along_y ? f.dv_dx : f.dv_dy;
  Rgb sum{};
  for (int i = 0; i < probes; ++i) {
    const float s = (static_cast<float>(i) + 0.5f) / static_cast<float>(probes) - 0.5f;
    sum = sum + trilinear(u + s * du, v + s * dv, lod);
  }
  return (1.0f / static_cast<float>(probes)) * sum;
}

}  // namespace raycast
