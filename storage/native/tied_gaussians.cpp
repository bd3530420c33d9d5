#include "tied_gaussians.hpp"

#include <algorithm>
#include <memory>

#include "attribute_model.hpp"

namespace vtslam {
namespace {

// Rows of per-pixel facts, this one and two above, with a border so that neighbours need no checks.
template <typename T>
class Rows {
 public:
  explicit Rows(int64_t width) : width_(width + 2 * kBorder), cells_(kRows * width_) {}
  T* row(int64_t index) { return cells_.data() + (index + kRows) % kRows * width_ + kBorder; }
  void clear(int64_t index) { std::fill_n(row(index) - kBorder, width_, T{}); }

 private:
  static constexpr int64_t kBorder = 2, kRows = 3;
  int64_t width_;
  std::vector<T> cells_;
};

// Where Gaussians are: a bit for the whole pixel, and bits for its quarters.
class TieModel {
 public:
  template <typename Coder>
  int code(Coder& coder, const uint8_t* here, const uint8_t* above, const uint8_t* above2, int view, int ties) {
    const int whole = coder.bit(whole_[view][whole_context(here, above, above2)], ties & 1);
    const int edges = edge_context(here, above) * 2 + whole;
    if (!coder.bit(any_quarter_[view][edges], ties > 1)) return whole;
    int found = 0;
    for (int quarter = 0; quarter < 4; ++quarter) {
      const int context = (whole * 4 + quarter) * 8 + found;
      if (quarter == 3 && found == 0) {
        found = 8;  // one there is
      } else {
        found |= coder.bit(quarters_[context], ties >> (quarter + 1) & 1) << quarter;
      }
    }
    return whole | found << 1;
  }

 private:
  static int whole_context(const uint8_t* here, const uint8_t* above, const uint8_t* above2) {
    const uint8_t cells[] = {here[-1], here[-2], above[-2],  above[-1], above[0],
                             above[1], above[2], above2[-1], above2[0], above2[1]};
    int out = 0;
    for (const uint8_t cell : cells) out = out << 1 | (cell & 1);
    return out;
  }
  static int edge_context(const uint8_t* here, const uint8_t* above) {
    const uint8_t cells[] = {here[-1], here[-2], above[-1], above[0], above[1]};
    int out = 0;
    for (const uint8_t cell : cells) out = out << 1 | (cell > 1);
    return out;
  }

  AdaptiveBit whole_[3][1024];
  AdaptiveBit any_quarter_[3][64];
  AdaptiveBit quarters_[64];
};

// Ranks of the depths at the pixels of one frame that have Gaussians.
class DepthModel {
 public:
  // `seen`: the pixel's rank in the frame's own depth image, or 0. It is almost always the one.
  template <typename Coder>
  int32_t code(Coder& coder, const int32_t* here, const int32_t* above, int32_t seen, int32_t value, int32_t largest) {
    const Guess guess = seen ? Guess{seen, kOfView} : guessed(here, above);
    latest_ = guess.rank + residuals_[guess.context].code(coder, value - guess.rank, 0);
    if (latest_ < 1 || latest_ > largest) throw std::invalid_argument("a depth is outside of its list");
    return latest_;
  }

 private:
  struct Guess {
    int32_t rank;
    int context;
  };

  Guess guessed(const int32_t* here, const int32_t* above) const {
    const int32_t near[] = {here[-1], above[0], above[-1], above[1], here[-2], above[2]};
    int32_t guess = latest_, spread = 60;
    int present = 0;
    int32_t low = 0, high = 0;
    for (const int32_t rank : near) {
      if (!rank) continue;
      if (!present++) guess = low = high = rank;
      low = std::min(low, rank);
      high = std::max(high, rank);
    }
    if (near[0] && near[1]) guess = (near[0] + near[1]) / 2;
    if (near[0] && near[1] && near[2]) guess = std::clamp(near[0] + near[1] - near[2], low, high);
    if (present > 1) spread = high - low;
    return {guess, std::min(present, 3) * 8 + magnitude_bucket(spread / 2)};
  }

  static constexpr int kOfView = 32;
  int32_t latest_ = 1;
  AdaptiveNumber residuals_[kOfView + 1];
};

template <typename Coder, typename Columns>
class Stream {
 public:
  Stream(Coder& coder, const TiedGaussians& ties, const Columns& columns)
      : coder_(coder), ties_(ties), columns_(columns), tied_(ties.width), ranks_(ties.width), known_(ties.width) {}

  void run() {
    int64_t first = 0;
    for (int64_t frame = 0; frame < ties_.frames; ++frame) {
      const int64_t whole = ties_.counts[2 * frame], quarters = ties_.counts[2 * frame + 1];
      next_[0] = first;
      end_[0] = next_[1] = first + whole;
      end_[1] = first = first + whole + quarters;
      if (whole + quarters) code_frame(frame);
    }
  }

 private:
  void code_frame(int64_t frame) {
    view_ = ties_.view_of[frame] < 0 ? nullptr : ties_.view_ranks + ties_.view_of[frame] * ties_.height * ties_.width;
    for (int row = -2; row < 0; ++row) clear(row);
    for (int64_t row = 0; row < ties_.height; ++row) {
      clear(row);
      for (int64_t column = 0; column < ties_.width; ++column) code_pixel(row, column);
    }
    if (next_[0] != end_[0] || next_[1] != end_[1])
      throw std::invalid_argument("Gaussians are doubled, missing or out of order");
  }

  void clear(int64_t row) {
    tied_.clear(row);
    ranks_.clear(row);
    known_.clear(row);
  }

  void code_pixel(int64_t row, int64_t column) {
    const int32_t pixel = static_cast<int32_t>(row * ties_.width + column);
    const int32_t view_rank = view_ ? view_[pixel] : 0;
    uint8_t* const tied = tied_.row(row) + column;
    const int state = !view_ ? 0 : view_rank ? 2 : 1;
    *tied = static_cast<uint8_t>(ties_model_->code(coder_, tied, tied_.row(row - 1) + column,
                                                   tied_.row(row - 2) + column, state, wanted(pixel)));
    if (!*tied) return;
    int32_t* const rank = ranks_.row(row) + column;
    *rank = depth_model_->code(coder_, rank, ranks_.row(row - 1) + column, view_rank, wanted_rank(*tied),
                               ties_.largest_rank);
    for (int sub = 0; sub < 5; ++sub) {
      if (*tied >> sub & 1) code_gaussian(row, column, pixel, sub, *rank);
    }
  }

  // The ties of a pixel as the columns have them, for the encoder.
  int wanted(int32_t pixel) const {
    if constexpr (Coder::kDecodes) return 0;
    int out = next_[0] < end_[0] && columns_.pixel[next_[0]] == pixel;
    for (int64_t i = next_[1]; i < end_[1] && columns_.pixel[i] == pixel; ++i) out |= 1 << columns_.subpixel[i];
    return out;
  }

  int32_t wanted_rank(int tied) const {
    if constexpr (Coder::kDecodes) return 0;
    return columns_.rank[next_[tied & 1 ? 0 : 1]];
  }

  void code_gaussian(int64_t row, int64_t column, int32_t pixel, int sub, int32_t rank) {
    const int kind = sub > 0;
    if (next_[kind] == end_[kind]) throw std::invalid_argument("there are more Gaussians than counted");
    const int64_t index = next_[kind]++;
    if constexpr (Coder::kDecodes) {
      columns_.pixel[index] = pixel;
      columns_.subpixel[index] = static_cast<uint8_t>(sub);
      columns_.rank[index] = rank;
    } else if (columns_.pixel[index] != pixel || columns_.subpixel[index] != sub || columns_.rank[index] != rank) {
      throw std::invalid_argument("Gaussians are out of order, or differ in depth from their pixel");
    }
    const Neighbourhood near = neighbourhood(row, column, kind);
    Known found;
    models_[kind]->code(coder_, ties_.coarseness, near, latest_[kind], columns_.levels + kChannels * index, found);
    latest_[kind] = found;
    known_.row(row)[column] = found;
    seen_in_pixel_ = pixel;
  }

  // For a quarter the pixel's own latest Gaussian comes first.
  Neighbourhood neighbourhood(int64_t row, int64_t column, int kind) {
    const uint8_t *tied = tied_.row(row) + column, *tied_above = tied_.row(row - 1) + column;
    const uint8_t* tied_above2 = tied_.row(row - 2) + column;
    const Known *known = known_.row(row) + column, *known_above = known_.row(row - 1) + column;
    const Known* known_above2 = known_.row(row - 2) + column;
    const bool own = kind && seen_in_pixel_ == static_cast<int32_t>(row * ties_.width + column);
    return {tied[-1] ? known - 1 : nullptr,
            tied_above[0] ? known_above : nullptr,
            tied_above[-1] ? known_above - 1 : nullptr,
            tied_above[1] ? known_above + 1 : nullptr,
            kind ? (own ? known : nullptr) : (tied[-2] ? known - 2 : nullptr),
            kind ? nullptr : (tied_above2[0] ? known_above2 : nullptr)};
  }

  Coder& coder_;
  const TiedGaussians& ties_;
  const Columns& columns_;
  Rows<uint8_t> tied_;
  Rows<int32_t> ranks_;
  Rows<Known> known_;
  const int32_t* view_ = nullptr;
  int64_t next_[2] = {0, 0}, end_[2] = {0, 0};
  int32_t seen_in_pixel_ = -1;
  Known latest_[2];
  std::unique_ptr<TieModel> ties_model_ = std::make_unique<TieModel>();
  std::unique_ptr<DepthModel> depth_model_ = std::make_unique<DepthModel>();
  std::unique_ptr<AttributeModel> models_[2] = {std::make_unique<AttributeModel>(), std::make_unique<AttributeModel>()};
};

}  // namespace

std::vector<uint8_t> encode_gaussians(const TiedGaussians& ties, const GaussiansIn& columns) {
  Encoder coder;
  Stream<Encoder, GaussiansIn>(coder, ties, columns).run();
  return coder.finished();
}

void decode_gaussians(std::span<const uint8_t> bytes, const TiedGaussians& ties, const GaussiansOut& columns) {
  Decoder coder(bytes);
  Stream<Decoder, GaussiansOut>(coder, ties, columns).run();
  coder.finish();
}

}  // namespace vtslam
