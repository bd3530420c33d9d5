// Adaptive binary range coder with carry: the arithmetic of section files' dense streams (docs/format-section.md, 6).
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <stdexcept>
#include <vector>

namespace vtslam {

constexpr int kProbabilityBits = 15;
constexpr uint32_t kRangeFloor = 1u << 24;

// Probability of a zero, learned: quickly at first, then over about the last kMemory bits.
class AdaptiveBit {
 public:
  uint32_t zero() const { return probability_; }
  void learn(int bit) {
    const int target = bit ? kLeast : kMost;
    probability_ += (target - static_cast<int>(probability_)) / (seen_ + 2);
    if (seen_ < kMemory) ++seen_;
  }

 private:
  static constexpr int kLeast = 1 << 5, kMost = (1 << kProbabilityBits) - (1 << 5), kMemory = 120;
  int probability_ = 1 << (kProbabilityBits - 1);
  int seen_ = 0;
};

class Encoder {
 public:
  static constexpr bool kDecodes = false;

  int bit(AdaptiveBit& model, int value) {
    const uint32_t bound = (range_ >> kProbabilityBits) * model.zero();
    if (value) {
      low_ += bound;
      range_ -= bound;
    } else {
      range_ = bound;
    }
    model.learn(value);
    while (range_ < kRangeFloor) {
      range_ <<= 8;
      shift_low();
    }
    return value;
  }

  std::vector<uint8_t> finished() {
    for (int i = 0; i < 5; ++i) shift_low();
    return std::move(bytes_);
  }

 private:
  void shift_low() {
    if (low_ < 0xFF000000u || low_ >= (1ull << 32)) {
      const uint8_t carry = static_cast<uint8_t>(low_ >> 32);
      bytes_.push_back(static_cast<uint8_t>(cache_ + carry));
      for (; waiting_ > 0; --waiting_) bytes_.push_back(static_cast<uint8_t>(0xFF + carry));
      cache_ = static_cast<uint8_t>(low_ >> 24);
    } else {
      ++waiting_;
    }
    low_ = (low_ << 8) & 0xFFFFFFFFu;
  }

  uint64_t low_ = 0, waiting_ = 0;
  uint32_t range_ = 0xFFFFFFFFu;
  uint8_t cache_ = 0;
  std::vector<uint8_t> bytes_;
};

// Reads what Encoder wrote. Every bit takes a share of a byte, so the work is bounded by the stream's length.
class Decoder {
 public:
  static constexpr bool kDecodes = true;

  explicit Decoder(std::span<const uint8_t> bytes) : bytes_(bytes) {
    for (int i = 0; i < 5; ++i) code_ = (code_ << 8) | next();
  }

  int bit(AdaptiveBit& model, int = 0) {
    const uint32_t bound = (range_ >> kProbabilityBits) * model.zero();
    const int value = code_ >= bound;
    if (value) {
      code_ -= bound;
      range_ -= bound;
    } else {
      range_ = bound;
    }
    model.learn(value);
    while (range_ < kRangeFloor) {
      range_ <<= 8;
      code_ = (code_ << 8) | next();
    }
    return value;
  }

  void finish() const {
    if (place_ != bytes_.size()) throw std::invalid_argument("bytes are left after the stream's end");
  }

 private:
  uint8_t next() {
    if (place_ >= bytes_.size()) throw std::invalid_argument("the stream ends before its content");
    return bytes_[place_++];
  }

  std::span<const uint8_t> bytes_;
  size_t place_ = 0;
  uint32_t range_ = 0xFFFFFFFFu, code_ = 0;
};

// A whole number: zero, sign, then size in unary, beyond kUnary in exponential Golomb form.
class AdaptiveNumber {
 public:
  template <typename Coder>
  int32_t code(Coder& coder, int32_t value, int lean) {
    if (!coder.bit(zero_[lean], value != 0)) return 0;
    const bool negative = coder.bit(sign_[lean], value < 0);
    const int32_t size = size_above_one(coder, value < 0 ? -value : value);
    return negative ? -size : size;
  }

  static constexpr int32_t kLargest = 1 << 20;
  static constexpr int kLeans = 5;

 private:
  static constexpr int kUnary = 14, kEscapeBits = 21;

  template <typename Coder>
  int32_t size_above_one(Coder& coder, int32_t size) {
    for (int i = 0; i < kUnary; ++i) {
      if (!coder.bit(more_[i], size > i + 1)) return i + 1;
    }
    const uint32_t rest = static_cast<uint32_t>(size - kUnary);  // at least 1
    int bits = 0;
    while (coder.bit(length_[bits], bits < kEscapeBits && (rest >> (bits + 1)) != 0)) {
      if (++bits >= kEscapeBits) throw std::invalid_argument("a number is too large");
    }
    uint32_t found = 1;
    for (int place = bits - 1; place >= 0; --place) {
      found = (found << 1) | static_cast<uint32_t>(coder.bit(low_[place], (rest >> place) & 1));
    }
    return static_cast<int32_t>(found) + kUnary;
  }

  std::array<AdaptiveBit, kLeans> zero_, sign_;
  std::array<AdaptiveBit, kUnary> more_;
  std::array<AdaptiveBit, kEscapeBits + 1> length_, low_;
};

}  // namespace vtslam
