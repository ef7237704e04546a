#include <algorithm>
#include <limits>

#include "fft.hpp"
#include "terrainloop/search.hpp"

namespace terrainloop::search {
namespace {

constexpr float kRounding = 1e-6f;  // of the FFT, relative to the largest value

Complex lanes_at(const float* spectrum, int wave) {
  const float* at = spectrum + static_cast<std::size_t>(wave) * 2 * kLanes;
  return {Eigen::Map<const Lanes>(at), Eigen::Map<const Lanes>(at + kLanes)};
}

Complex times(const Complex& a, const float* b) {
  return {a.re * b[0] - a.im * b[1], a.re * b[1] + a.im * b[0]};
}

/// What is kept of one block of groups while its rotations are tried.
class Block {
 public:
  Block(const TurnedSpectra& source, const float* stored, int size, double least_shared)
      : source_(source),
        stored_(stored),
        size_(size),
        shifts_(size * size),
        fft_(size),
        scale_(1.0f / static_cast<float>(shifts_)),
        least_(static_cast<float>(least_shared)),
        shared_(shifts_),
        weight_(shifts_),
        agreement_(shifts_) {}

  void run(int block, double evident, Correlations& found) {
    measure_ground(block);
    for (int turn = 0; turn < source_.turns; ++turn) {
      correlate_fields(block, turn);
      const Lanes sample = (sum_ / count_.max(1.0f)).max(1.0f);
      for (int lane = 0; lane < kLanes; ++lane) {
        const int rotation = (block * kLanes + lane) * source_.turns + turn;
        found.admissible[rotation] = count_[lane];
        found.sample[rotation] = count_[lane] > 0 ? sample[lane] : std::numeric_limits<double>::quiet_NaN();
      }
      find_evident(block, turn, sample, static_cast<float>(evident), found);
    }
  }

 private:
  std::size_t half() const { return static_cast<std::size_t>(size_) * fft_.waves(); }

  /// Shared ground at each shift, and by what a sum of products becomes a correlation; 0 where it is too
  /// little.
  void measure_ground(int block) {
    const std::size_t lanes = half() * 2 * kLanes;
    const float* known = source_.ground + block * 2 * lanes;
    const float *energy = known + lanes, *stored_known = stored_ + 2 * 2 * half(),
                *stored_energy = stored_known + 2 * half();
    const auto product = [](const float* a, const float* b) {
      return [a, b](int wave) { return times(lanes_at(a, wave), b + 2 * wave); };
    };
    fft_(product(known, stored_known), [&](int row, const Lanes* line) {
      for (int column = 0; column < size_; ++column) shared_[row * size_ + column] = scale_ * line[column];
    });
    fft_(product(known, stored_energy),
         [&](int row, const Lanes* line) { std::copy(line, line + size_, &weight_[row * size_]); });
    Lanes largest = Lanes::Constant(std::numeric_limits<float>::min());
    fft_(product(energy, stored_known), [&](int row, const Lanes* line) {
      for (int column = 0; column < size_; ++column) {
        Lanes& energies = weight_[row * size_ + column];
        energies *= scale_ * scale_ * line[column];
        largest = largest.max(energies);
      }
    });
    count_.setZero();
    const Lanes floor = Lanes::Constant(kRounding * largest.maxCoeff());
    for (int shift = 0; shift < shifts_; ++shift) {
      const Lanes enough = (shared_[shift] > least_).cast<float>();
      count_ += enough;
      weight_[shift] = scale_ * scale_ * enough * shared_[shift] / weight_[shift].max(floor);
    }
  }

  /// Signed r^2 times the shared ground at each shift, and its sum over them.
  void correlate_fields(int block, int turn) {
    const std::size_t lanes = half() * 2 * kLanes;
    const float* x = source_.fields + (block * source_.turns + turn) * 2 * lanes;
    const float *y = x + lanes, *stored_y = stored_ + 2 * half();
    const auto product = [&](int wave) {
      return times(lanes_at(x, wave), stored_ + 2 * wave) + times(lanes_at(y, wave), stored_y + 2 * wave);
    };
    sum_.setZero();
    fft_(product, [&](int row, const Lanes* line) {
      for (int column = 0, shift = row * size_; column < size_; ++column, ++shift) {
        agreement_[shift] = line[column] * line[column].abs() * weight_[shift];
        sum_ += agreement_[shift].abs();
      }
    });
  }

  void find_evident(int block, int turn, const Lanes& sample, float evident, Correlations& found) const {
    const Lanes least = evident * sample;
    for (int shift = 0; shift < shifts_; ++shift) {
      if (!(agreement_[shift] > least).any()) continue;
      for (int lane = 0; lane < kLanes; ++lane)
        if (agreement_[shift][lane] > least[lane] && is_peak(shift, lane)) {
          const float shared = shared_[shift][lane];
          found.evident.push_back({(block * kLanes + lane) * source_.turns + turn, shift / size_,
                                   shift % size_, agreement_[shift][lane] / shared, shared / sample[lane]});
        }
    }
  }

  /// Whether no shift beside this one agrees better; of equals the first counts.
  bool is_peak(int shift, int lane) const {
    const int row = shift / size_, column = shift % size_;
    for (const int down : {size_ - 1, 0, 1})
      for (const int right : {size_ - 1, 0, 1}) {
        const int beside = (row + down) % size_ * size_ + (column + right) % size_;
        const float there = agreement_[beside][lane], here = agreement_[shift][lane];
        if (there > here || (there == here && beside < shift)) return false;
      }
    return true;
  }

  const TurnedSpectra& source_;
  const float* stored_;
  int size_, shifts_;
  InverseRealFft2 fft_;
  float scale_, least_;
  std::vector<Lanes> shared_, weight_, agreement_;
  Lanes count_, sum_;
};

}  // namespace

std::vector<float> conjugate_spectra(const float* images, int blocks, int turns, int extent, int size) {
  const std::size_t pixels = static_cast<std::size_t>(extent) * extent, pair = 2 * pixels;
  const std::size_t waves = static_cast<std::size_t>(size) * (size / 2 + 1);
  std::vector<float> spectra(static_cast<std::size_t>(blocks) * turns * 2 * waves * 2 * kLanes);
  ConjugateFft2 fft(size);
  for (int block = 0; block < blocks; ++block)
    for (int turn = 0; turn < turns; ++turn) {
      const float* first = images + (block * kLanes * turns + turn) * pair;
      float* out = &spectra[(block * turns + turn) * 2 * waves * 2 * kLanes];
      const auto pixel = [&](int row, int column) {
        Complex z;
        for (int lane = 0; lane < kLanes; ++lane) {
          const float* at = first + lane * turns * pair + row * extent + column;
          z.re[lane] = at[0];
          z.im[lane] = at[pixels];
        }
        return z;
      };
      fft(extent, pixel, [&](int which, int wave, const Complex& value) {
        float* at = out + (which * waves + wave) * 2 * kLanes;
        Eigen::Map<Lanes>{at} = value.re;
        Eigen::Map<Lanes>{at + kLanes} = value.im;
      });
    }
  return spectra;
}

Correlations correlate(const TurnedSpectra& source, const float* stored, int size, double least_shared,
                       double evident) {
  const std::size_t rotations = static_cast<std::size_t>(source.blocks) * kLanes * source.turns;
  Correlations found{{}, std::vector<double>(rotations), std::vector<double>(rotations)};
  Block work(source, stored, size, least_shared);
  for (int block = 0; block < source.blocks; ++block) work.run(block, evident, found);
  return found;
}

}  // namespace terrainloop::search
