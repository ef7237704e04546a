#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "fft.hpp"
#include "search.hpp"

namespace terrainloop::search {
namespace {

constexpr int kLargest = 8192;      // memory grows with its square, to 8 GB
constexpr float kRounding = 1e-6f;  // of the FFT, relative to the largest value

Complex lanes_at(const float* spectrum, int wave) {
  const float* at = spectrum + static_cast<std::size_t>(wave) * 2 * kLanes;
  return {Eigen::Map<const Lanes>(at), Eigen::Map<const Lanes>(at + kLanes)};
}

Complex times(const Complex& a, const float* b) {
  return {a.re * b[0] - a.im * b[1], a.re * b[1] + a.im * b[0]};
}

/// The state of one block of rotations while it is processed.
class Block {
 public:
  Block(const TurnedSpectra& source, const StoredSpectra& stored, int size, double least_shared)
      : source_(source),
        stored_(stored),
        size_(size),
        half_(size / 2),
        fft_(size),
        half_fft_(half_),
        least_(static_cast<float>(least_shared)),
        half_shared_(half_ * half_),
        half_energies_(half_ * half_),
        weight_(size * size),
        agreement_(size * size) {}

  void run(int block, double evident, Correlations& found) {
    measure_ground(block);
    weigh();
    correlate_fields(block);
    const Lanes sample = (sum_ / count_.max(1.0f)).max(1.0f);
    for (int lane = 0; lane < kLanes; ++lane) {
      const int rotation = block * kLanes + lane;
      found.admissible[rotation] = count_[lane];
      found.sample[rotation] = count_[lane] > 0 ? sample[lane] : std::numeric_limits<double>::quiet_NaN();
    }
    find_evident(block, sample, static_cast<float>(evident), found);
  }

 private:
  /// Number of shared pixels, and the product of the energies over them, at every second shift.
  void measure_ground(int block) {
    const std::size_t waves = static_cast<std::size_t>(half_) * half_fft_.waves();
    const float* known = source_.ground + block * 2 * waves * 2 * kLanes;
    const float* energy = known + waves * 2 * kLanes;
    const float *stored_known = stored_.ground, *stored_energy = stored_known + 2 * waves;
    // 2 x 2 pixels times 2 x 2 others: each pixel is counted four times.
    const float scale = 1.0f / 4.0f / static_cast<float>(half_ * half_);
    const auto product = [](const float* a, const float* b) {
      return [a, b](int wave) { return times(lanes_at(a, wave), b + 2 * wave); };
    };
    half_fft_(product(known, stored_known), [&](int row, const Lanes* line) {
      for (int column = 0; column < half_; ++column)
        half_shared_[row * half_ + column] = scale * line[column];
    });
    half_fft_(product(known, stored_energy), [&](int row, const Lanes* line) {
      for (int column = 0; column < half_; ++column)
        half_energies_[row * half_ + column] = scale * line[column];
    });
    half_fft_(product(energy, stored_known), [&](int row, const Lanes* line) {
      for (int column = 0; column < half_; ++column)
        half_energies_[row * half_ + column] *= scale * line[column];
    });
  }

  /// At every shift, the factor from the square of a sum of products to r^2 times the shared area; 0 where
  /// the area is too small.
  void weigh() {
    Lanes largest = Lanes::Constant(std::numeric_limits<float>::min());
    for (const Lanes& energies : half_energies_) largest = largest.max(energies);
    const Lanes floor = Lanes::Constant(kRounding * largest.maxCoeff());
    const float scale = 1.0f / static_cast<float>(size_) / static_cast<float>(size_);
    count_.setZero();
    for (int row = 0, shift = 0; row < size_; ++row)
      for (int column = 0; column < size_; ++column, ++shift) {
        const Lanes shared = between(half_shared_, row, column);
        const Lanes enough = (shared > least_).cast<float>();
        count_ += enough;
        weight_[shift] = scale * scale * enough * shared / between(half_energies_, row, column).max(floor);
      }
  }

  /// Values at every second row and column, interpolated.
  Lanes between(const std::vector<Lanes>& values, int row, int column) const {
    const int above = row / 2 * half_, below = (row + 1) / 2 % half_ * half_;
    const int left = column / 2, right = (column + 1) / 2 % half_;
    return 0.25f *
           (values[above + left] + values[above + right] + values[below + left] + values[below + right]);
  }

  /// Signed r^2 times the shared area at each shift, and the sum of its absolute values.
  void correlate_fields(int block) {
    const std::size_t waves = static_cast<std::size_t>(size_) * fft_.waves();
    const float* x = source_.fields + block * 2 * waves * 2 * kLanes;
    const float *y = x + waves * 2 * kLanes, *stored_x = stored_.field, *stored_y = stored_x + 2 * waves;
    const auto product = [&](int wave) {
      return times(lanes_at(x, wave), stored_x + 2 * wave) + times(lanes_at(y, wave), stored_y + 2 * wave);
    };
    sum_.setZero();
    fft_(product, [&](int row, const Lanes* line) {
      for (int column = 0, shift = row * size_; column < size_; ++column, ++shift) {
        agreement_[shift] = line[column] * line[column].abs() * weight_[shift];
        sum_ += agreement_[shift].abs();
      }
    });
  }

  void find_evident(int block, const Lanes& sample, float evident, Correlations& found) const {
    const Lanes least = evident * sample;
    for (int row = 0, shift = 0; row < size_; ++row)
      for (int column = 0; column < size_; ++column, ++shift) {
        if (!(agreement_[shift] > least).any()) continue;
        const Lanes shared = between(half_shared_, row, column);
        for (int lane = 0; lane < kLanes; ++lane)
          if (agreement_[shift][lane] > least[lane] && is_peak(row, column, lane))
            found.evident.push_back({block * kLanes + lane, row, column,
                                     agreement_[shift][lane] / shared[lane], shared[lane] / sample[lane]});
      }
  }

  /// Whether no neighbouring shift agrees better; of equal ones the first counts.
  bool is_peak(int row, int column, int lane) const {
    const int shift = row * size_ + column;
    for (const int down : {size_ - 1, 0, 1})
      for (const int right : {size_ - 1, 0, 1}) {
        const int beside = (row + down) % size_ * size_ + (column + right) % size_;
        const float there = agreement_[beside][lane], here = agreement_[shift][lane];
        if (there > here || (there == here && beside < shift)) return false;
      }
    return true;
  }

  const TurnedSpectra& source_;
  const StoredSpectra& stored_;
  int size_, half_;
  InverseRealFft2 fft_, half_fft_;
  float least_;
  std::vector<Lanes> half_shared_, half_energies_, weight_, agreement_;
  Lanes count_, sum_;
};

void check_size(int size) {
  if (size < 1 || size > kLargest) throw std::invalid_argument("size must be within 1..8192");
}

}  // namespace

std::vector<float> conjugate_spectra(const float* images, int blocks, int extent, int size) {
  check_size(size);
  if (blocks < 0 || extent < 0 || extent > size)
    throw std::invalid_argument("blocks and extent must not be negative, nor extent larger than size");
  const std::size_t pixels = static_cast<std::size_t>(extent) * extent, pair = 2 * pixels;
  const std::size_t waves = static_cast<std::size_t>(size) * (size / 2 + 1);
  std::vector<float> spectra(static_cast<std::size_t>(blocks) * 2 * waves * 2 * kLanes);
  ConjugateFft2 fft(size);
  for (int block = 0; block < blocks; ++block) {
    const float* first = images + block * kLanes * pair;
    float* out = &spectra[block * 2 * waves * 2 * kLanes];
    const auto pixel = [&](int row, int column) {
      Complex z;
      for (int lane = 0; lane < kLanes; ++lane) {
        const float* at = first + lane * pair + row * extent + column;
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

Correlations correlate(const TurnedSpectra& source, const StoredSpectra& stored, int size,
                       double least_shared, double evident) {
  check_size(size);
  if (size % 4 != 0) throw std::invalid_argument("size must be a multiple of 4");
  if (source.blocks < 0) throw std::invalid_argument("blocks must not be negative");
  if (!(least_shared >= 0.0) || !(evident >= 0.0))
    throw std::invalid_argument("least_shared and evident must not be negative");
  const std::size_t rotations = static_cast<std::size_t>(source.blocks) * kLanes;
  Correlations found{{}, std::vector<double>(rotations), std::vector<double>(rotations)};
  Block work(source, stored, size, least_shared);
  for (int block = 0; block < source.blocks; ++block) work.run(block, evident, found);
  return found;
}

}  // namespace terrainloop::search
