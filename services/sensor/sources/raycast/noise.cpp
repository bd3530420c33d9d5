#include "noise.hpp"

#include <vector>

#include "parallel.hpp"

namespace raycast {
namespace {

std::uint32_t mixed(std::uint32_t h) {
  h ^= h >> 16;
  h *= 0x7feb352du;
  h ^= h >> 15;
  h *= 0x846ca68bu;
  return h ^ (h >> 16);
}

struct Gradient {
  float x, y;
};

constexpr float kOctaveGain = 3.9f;  // brings one octave of unit-gradient noise to a range of about -2 to 2

Gradient gradient(std::uint32_t hash) {
  // 16 unit vectors, as exact decimals: no trigonometry, no difference between machines.
  static constexpr float kX[4] = {0.98078528f, 0.83146961f, 0.55557023f, 0.19509032f};
  static constexpr float kY[4] = {0.19509032f, 0.55557023f, 0.83146961f, 0.98078528f};
  const int k = static_cast<int>(hash & 3u);
  return {(hash & 4u) ? -kX[k] : kX[k], (hash & 8u) ? -kY[k] : kY[k]};
}

float fade(float t) { return t * t * t * (t * (t * 6.0f - 15.0f) + 10.0f); }

struct Column {
  int left, right;
  float offset, weight;
};

std::vector<Column> columns(int size, int cells) {
  std::vector<Column> out(size);
  for (int i = 0; i < size; ++i) {
    const float position = (static_cast<float>(i) + 0.5f) * static_cast<float>(cells) / static_cast<float>(size);
    const int cell = static_cast<int>(position);
    const float offset = position - static_cast<float>(cell);
    out[i] = {cell % cells, (cell + 1) % cells, offset, fade(offset)};
  }
  return out;
}

void add_octave(const NoiseSettings& s, int cells_y, int cells_x, float amplitude, std::uint32_t salt, int num_threads,
                float* out) {
  std::vector<Gradient> lattice(static_cast<std::size_t>(cells_y) * cells_x);
  for (std::size_t i = 0; i < lattice.size(); ++i) lattice[i] = gradient(mixed(static_cast<std::uint32_t>(i) ^ salt));
  const auto across = columns(s.width, cells_x), down = columns(s.height, cells_y);
  constexpr int kRows = 32;
  parallel_for((s.height + kRows - 1) / kRows, num_threads, [&](int band) {
    for (int y = band * kRows; y < std::min(s.height, (band + 1) * kRows); ++y) {
      const Column v = down[y];
      const Gradient* top = &lattice[static_cast<std::size_t>(v.left) * cells_x];
      const Gradient* bottom = &lattice[static_cast<std::size_t>(v.right) * cells_x];
      float* row = out + static_cast<std::size_t>(y) * s.width;
      for (int x = 0; x < s.width; ++x) {
        const Column u = across[x];
        const Gradient g00 = top[u.left], g01 = top[u.right], g10 = bottom[u.left], g11 = bottom[u.right];
        const float n00 = g00.x * u.offset + g00.y * v.offset;
        const float n01 = g01.x * (u.offset - 1.0f) + g01.y * v.offset;
        const float n10 = g10.x * u.offset + g10.y * (v.offset - 1.0f);
        const float n11 = g11.x * (u.offset - 1.0f) + g11.y * (v.offset - 1.0f);
        const float a = n00 + (n01 - n00) * u.weight, b = n10 + (n11 - n10) * u.weight;
        row[x] += amplitude * (a + (b - a) * v.weight);
      }
    }
  });
}

}  // namespace

void fractal_noise(const NoiseSettings& s, int num_threads, float* out) {
  std::fill(out, out + static_cast<std::size_t>(s.height) * s.width, 0.0f);
  float amplitude = kOctaveGain;
  int cells_y = s.cells_y, cells_x = s.cells_x;
  for (int octave = 0; octave < s.octaves; ++octave) {
    if (2 * cells_y > s.height || 2 * cells_x > s.width) break;
    add_octave(s, cells_y, cells_x, amplitude, mixed(s.seed * 31u + static_cast<std::uint32_t>(octave) + 1u),
               num_threads, out);
    amplitude *= s.gain;
    cells_y *= 2;
    cells_x *= 2;
  }
}

}  // namespace raycast
