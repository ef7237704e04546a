#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>
#include <vector>

#include "search.hpp"

namespace terrainloop::search {

constexpr double kPi = 3.14159265358979323846;

using Lanes = Eigen::Array<float, kLanes, 1>;

/// One complex number in each lane.
struct Complex {
  Lanes re, im;
};

inline Complex operator+(const Complex& a, const Complex& b) { return {a.re + b.re, a.im + b.im}; }
inline Complex operator-(const Complex& a, const Complex& b) { return {a.re - b.re, a.im - b.im}; }
inline Complex operator*(float s, const Complex& a) { return {s * a.re, s * a.im}; }
inline Complex times_i(const Complex& a) { return {-a.im, a.re}; }

/// exp(2 pi i k / n), the same in every lane.
struct Phase {
  float re, im;
  Phase(int k, int n)
      : re(static_cast<float>(std::cos(2 * kPi * k / n))),
        im(static_cast<float>(std::sin(2 * kPi * k / n))) {}
};

inline Complex operator*(const Phase& w, const Complex& a) {
  return {w.re * a.re - w.im * a.im, w.re * a.im + w.im * a.re};
}

/// Unscaled inverse FFT, sum of X_k exp(2 pi i j k / n), kLanes at a time, of contiguous numbers.
/// Stockham's: each pass sorts as it goes (Van Loan, Computational Frameworks for the FFT, 1992, 1.7).
class InverseFft {
 public:
  explicit InverseFft(int n) : n_(n) {
    if (n < 1) throw std::invalid_argument("size must be positive");
    for (const int radix : {4, 2, 3, 5})
      for (; n % radix == 0; n /= radix) add_pass(radix, n);
    if (n != 1) throw std::invalid_argument("size must have no factors but 2, 3 and 5");
  }

  /// Pointer to the result: `data` or `scratch`, both n long and both overwritten.
  Complex* operator()(Complex* data, Complex* scratch) const {
    int stride = 1;
    for (const Pass& pass : passes_) {
      switch (pass.radix) {
        case 2:
          run<2>(pass, stride, data, scratch);
          break;
        case 3:
          run<3>(pass, stride, data, scratch);
          break;
        case 4:
          run<4>(pass, stride, data, scratch);
          break;
        default:
          run<5>(pass, stride, data, scratch);
      }
      stride *= pass.radix;
      std::swap(data, scratch);
    }
    return data;
  }

 private:
  struct Pass {
    int radix;
    std::vector<Phase> twiddles;  // radix - 1 for each butterfly
  };

  void add_pass(int radix, int n) {
    Pass pass{radix, {}};
    for (int p = 0; p < n / radix; ++p)
      for (int k = 1; k < radix; ++k) pass.twiddles.emplace_back(p * k, n);
    passes_.push_back(std::move(pass));
  }

  template <int R>
  static void butterfly(Complex (&a)[R]) {
    if constexpr (R == 2) {
      const Complex sum = a[0] + a[1];
      a[1] = a[0] - a[1];
      a[0] = sum;
    } else if constexpr (R == 4) {
      const Complex even = a[0] + a[2], other = a[0] - a[2], odd = a[1] + a[3], turned = times_i(a[1] - a[3]);
      a[0] = even + odd;
      a[1] = other + turned;
      a[2] = even - odd;
      a[3] = other - turned;
    } else if constexpr (R == 3) {
      const Complex sum = a[1] + a[2], turned = times_i(0.866025404f * (a[1] - a[2]));
      const Complex middle = a[0] - 0.5f * sum;
      a[0] = a[0] + sum;
      a[1] = middle + turned;
      a[2] = middle - turned;
    } else {
      constexpr float c1 = 0.309016994f, c2 = -0.809016994f, s1 = 0.951056516f, s2 = 0.587785252f;
      const Complex p = a[1] + a[4], q = a[2] + a[3], r = a[1] - a[4], s = a[2] - a[3];
      const Complex m1 = a[0] + c1 * p + c2 * q, m2 = a[0] + c2 * p + c1 * q;
      const Complex t1 = times_i(s1 * r + s2 * s), t2 = times_i(s2 * r - s1 * s);
      a[0] = a[0] + p + q;
      a[1] = m1 + t1;
      a[2] = m2 + t2;
      a[3] = m2 - t2;
      a[4] = m1 - t1;
    }
  }

  template <int R>
  void run(const Pass& pass, int stride, const Complex* x, Complex* y) const {
    const int butterflies = n_ / (R * stride), apart = butterflies * stride;
    const Phase* w = pass.twiddles.data();
    for (int p = 0; p < butterflies; ++p, w += R - 1)
      for (int q = 0; q < stride; ++q) {
        Complex a[R];
        for (int k = 0; k < R; ++k) a[k] = x[q + stride * p + apart * k];
        butterfly<R>(a);
        Complex* out = y + q + stride * R * p;
        out[0] = a[0];
        for (int k = 1; k < R; ++k) out[stride * k] = w[k - 1] * a[k];
      }
  }

  int n_;
  std::vector<Pass> passes_;
};

/// Unscaled inverse FFT of half spectra (size x (size / 2 + 1)) to real images (size x size), by rows.
class InverseRealFft2 {
 public:
  explicit InverseRealFft2(int size)
      : size_(size), columns_(size), rows_(size / 2), buffer_(2 * size), line_(size) {
    if (size % 2 != 0) throw std::invalid_argument("size must be even");
    for (int k = 0; k < size / 2; ++k) phases_.emplace_back(k, size);
    spectrum_.resize(static_cast<std::size_t>(size) * waves());
  }

  int waves() const { return size_ / 2 + 1; }

  /// wave(k) is the k-th number of the half spectrum; consume(row, line) receives the result, `size` per
  /// line.
  template <typename Wave, typename Consume>
  void operator()(const Wave& wave, const Consume& consume) {
    for (int column = 0; column < waves(); ++column) {
      for (int row = 0; row < size_; ++row) buffer_[row] = wave(row * waves() + column);
      const Complex* transformed = columns_(buffer_.data(), buffer_.data() + size_);
      for (int row = 0; row < size_; ++row) spectrum_[row * waves() + column] = transformed[row];
    }
    for (int row = 0; row < size_; ++row) {
      to_real(&spectrum_[row * waves()]);
      consume(row, line_.data());
    }
  }

 private:
  /// Even entries of the result are the real part of a transform of half the length, odd ones the imaginary.
  void to_real(const Complex* x) {
    const int half = size_ / 2;
    for (int k = 0; k < half; ++k) {
      const Complex mirrored{x[half - k].re, -x[half - k].im};
      buffer_[k] = (x[k] + mirrored) + times_i(phases_[k] * (x[k] - mirrored));
    }
    const Complex* transformed = rows_(buffer_.data(), buffer_.data() + size_);
    for (int k = 0; k < half; ++k) {
      line_[2 * k] = transformed[k].re;
      line_[2 * k + 1] = transformed[k].im;
    }
  }

  int size_;
  InverseFft columns_, rows_;
  std::vector<Phase> phases_;
  std::vector<Complex> buffer_, spectrum_;
  std::vector<Lanes> line_;
};

/// Conjugate half spectra of two real images, sum of x_j exp(2 pi i j k / size): those of x + i y,
/// separated.
class ConjugateFft2 {
 public:
  explicit ConjugateFft2(int size)
      : size_(size), fft_(size), buffer_(2 * size), plane_(static_cast<std::size_t>(size) * size) {}

  /// pixel(row, column) is x + i y, of a square with sides of `extent` pixels; write(which, wave, value)
  /// receives the value at a frequency in the half spectrum of image 0 or 1.
  template <typename Pixel, typename Write>
  void operator()(int extent, const Pixel& pixel, const Write& write) {
    const Complex zero{Lanes::Zero(), Lanes::Zero()};
    for (int row = 0; row < extent; ++row) {
      for (int column = 0; column < size_; ++column)
        buffer_[column] = column < extent ? pixel(row, column) : zero;
      const Complex* transformed = fft_(buffer_.data(), buffer_.data() + size_);
      std::copy(transformed, transformed + size_, &plane_[row * size_]);
    }
    for (int column = 0; column < size_; ++column) {
      for (int row = 0; row < size_; ++row) buffer_[row] = row < extent ? plane_[row * size_ + column] : zero;
      const Complex* transformed = fft_(buffer_.data(), buffer_.data() + size_);
      for (int row = 0; row < size_; ++row) plane_[row * size_ + column] = transformed[row];
    }
    for (int row = 0, wave = 0; row < size_; ++row)
      for (int column = 0; column <= size_ / 2; ++column, ++wave) {
        const Complex& here = plane_[row * size_ + column];
        const Complex& there = plane_[(size_ - row) % size_ * size_ + (size_ - column) % size_];
        write(0, wave, Complex{0.5f * (here.re + there.re), 0.5f * (here.im - there.im)});
        write(1, wave, Complex{0.5f * (here.im + there.im), 0.5f * (there.re - here.re)});
      }
  }

 private:
  int size_;
  InverseFft fft_;
  std::vector<Complex> buffer_, plane_;
};

}  // namespace terrainloop::search
