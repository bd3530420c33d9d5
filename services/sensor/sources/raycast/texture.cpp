#include "texture.hpp"

#include <algorithm>
#include <cmath>

#include "vec.hpp"

namespace raycast {
namespace {

constexpr int kMaxProbes = 6;

template <class Texel>
Rgb unpacked(Texel t) {
  return __builtin_convertvector(t, Rgb);
}

int floored(float x) {
  const int i = static_cast<int>(x);
  return i - (x < static_cast<float>(i) ? 1 : 0);
}

}  // namespace

Texture::Texture(const std::uint8_t* rgb, int height, int width) {
  Level base{width, height, std::vector<Texel>(static_cast<std::size_t>(width) * height)};
  for (std::size_t i = 0; i < base.texels.size(); ++i) {
    base.texels[i] = Texel{rgb[3 * i], rgb[3 * i + 1], rgb[3 * i + 2], 0};
  }
  levels_.push_back(std::move(base));
  while (levels_.back().width > 1 && levels_.back().height > 1) {
    const Level& fine = levels_.back();
    Level coarse{fine.width / 2, fine.height / 2, {}};
    coarse.texels.resize(static_cast<std::size_t>(coarse.width) * coarse.height);
    for (int y = 0; y < coarse.height; ++y) {
      const Texel *top = &fine.texels[static_cast<std::size_t>(2 * y) * fine.width], *bottom = top + fine.width;
      for (int x = 0; x < coarse.width; ++x) {
        const Rgb sum =
            unpacked(top[2 * x]) + unpacked(top[2 * x + 1]) + unpacked(bottom[2 * x]) + unpacked(bottom[2 * x + 1]);
        coarse.texels[static_cast<std::size_t>(y) * coarse.width + x] =
            __builtin_convertvector(sum * 0.25f + 0.5f, Texel);
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
  const float wx = x - static_cast<float>(left), wy = y - static_cast<float>(above);
  const Texel* top = &level.texels[static_cast<std::size_t>(y0) * level.width];
  const Texel* bottom = &level.texels[static_cast<std::size_t>(y1) * level.width];
  return ((1.0f - wx) * unpacked(top[x0]) + wx * unpacked(top[x1])) * (1.0f - wy) +
         ((1.0f - wx) * unpacked(bottom[x0]) + wx * unpacked(bottom[x1])) * wy;
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
  const int probes = std::min(kMaxProbes, static_cast<int>(std::min(longer / shorter, 1e6f) + 0.999f));
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
