// Prediction of a Gaussian's attribute levels from those coded before it at its own and at neighbouring pixels.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdlib>

#include "range_coder.hpp"
#include "tied_gaussians.hpp"

namespace vtslam {

using Levels = std::array<int32_t, kChannels>;

// What a pixel is known by to its neighbours: its latest Gaussian, and how far off the guesses about it were.
struct Known {
  Levels levels{}, errors{};
};

constexpr int kNeighbours = 6;  // at most; those absent are null
using Neighbourhood = std::array<const Known*, kNeighbours>;

inline int magnitude_bucket(int32_t size) {
  static constexpr int32_t kEdges[] = {1, 2, 3, 5, 8, 13, 24};
  int out = 0;
  while (out < 7 && size >= kEdges[out]) ++out;
  return out;
}

// A weighted mean of the neighbours, whose weights follow the data (normalised least mean squares).
class Predictor {
 public:
  static constexpr int kInputs = kNeighbours + kChannels;

  double predicted(const Neighbourhood& near, const Levels& own, int channel, int32_t fallback) {
    double sum = 0;
    int present = 0;
    for (const Known* known : near) {
      if (!known) continue;
      sum += known->levels[channel];
      ++present;
    }
    base_ = present ? sum / present : fallback;
    power_ = 1;
    for (int i = 0; i < kNeighbours; ++i) inputs_[i] = near[i] ? near[i]->levels[channel] - base_ : 0;
    for (int i = 0; i < kChannels; ++i) {
      inputs_[kNeighbours + i] = i < channel ? own[i] : 0;
    }
    guess_ = base_;
    for (int i = 0; i < kInputs; ++i) {
      guess_ += weights_[i] * inputs_[i];
      power_ += inputs_[i] * inputs_[i];
    }
    return guess_;
  }

  void learn(int32_t found) {
    const double step = kRate * (found - guess_) / power_;
    for (int i = 0; i < kInputs; ++i) weights_[i] += step * inputs_[i];
  }

 private:
  static constexpr double kRate = 0.003;
  double base_ = 0, guess_ = 0, power_ = 1;
  std::array<double, kInputs> inputs_{}, weights_{};
};

// Codes the levels of Gaussians of one kind (whole or quarter).
class AttributeModel {
 public:
  template <typename Coder, typename Level>
  void code(Coder& coder, const Coarseness& coarseness, const Neighbourhood& near, const Known& latest, Level* values,
            Known& out) {
    int32_t scale = 1;
    Levels own_errors{};
    for (int channel = 0; channel < kChannels; ++channel) {
      Predictor& predictor = predictors_[channel];
      const double guess = predictor.predicted(near, own_errors, channel, latest.levels[channel]);
      const double scaled = guess / scale;
      const double rounded = std::floor(scaled + 0.5);
      if (!(std::fabs(rounded) < AdaptiveNumber::kLargest)) throw std::invalid_argument("a guess is out of range");
      const int32_t whole = static_cast<int32_t>(rounded);
      AdaptiveNumber& number = numbers_[channel][activity(near, channel, scale)][beside(own_errors, channel)];
      const int32_t wanted = Coder::kDecodes ? 0 : values[channel] / scale - whole;
      const int32_t error = number.code(coder, wanted, lean(scaled - rounded));
      const int32_t found = (whole + error) * scale;
      if (std::abs(found) > AdaptiveNumber::kLargest) throw std::invalid_argument("a level is out of range");
      if constexpr (Coder::kDecodes) {
        values[channel] = found;
      } else if (values[channel] != found) {
        throw std::invalid_argument("a level is not on its coarser grid");
      }
      predictor.learn(found);
      own_errors[channel] = error;
      out.levels[channel] = found;
      out.errors[channel] = std::abs(error) * scale;
      if (channel == 0) scale = coarseness.scale(found);
    }
  }

 private:
  static constexpr int kActivities = 8, kBeside = 4;

  // How far off the guesses nearby were.
  static int activity(const Neighbourhood& near, int channel, int32_t scale) {
    int32_t sum = 0, present = 0;
    for (const Known* known : near) {
      if (!known) continue;
      sum += known->errors[channel];
      ++present;
    }
    return present ? magnitude_bucket(2 * sum / (present * scale)) : kActivities - 1;
  }

  // How far off the guesses of this Gaussian's earlier channels were.
  static int beside(const Levels& errors, int channel) {
    if (channel == 0) return 0;
    const int32_t last = std::abs(errors[channel - 1]) + (channel == 4 ? std::abs(errors[2]) : 0);
    return last == 0 ? 0 : last == 1 ? 1 : last < 4 ? 2 : 3;
  }

  // Which way, and how far, the guess was rounded.
  static int lean(double rest) { return rest < -0.3 ? 0 : rest < -0.1 ? 1 : rest <= 0.1 ? 2 : rest <= 0.3 ? 3 : 4; }

  std::array<Predictor, kChannels> predictors_;
  std::array<std::array<std::array<AdaptiveNumber, kBeside>, kActivities>, kChannels> numbers_;
};

}  // namespace vtslam
