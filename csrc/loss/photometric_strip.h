// SPDX-License-Identifier: Apache-2.0
// The photometric loss of one strip of rows on the CPU. The file is compiled twice, for the baseline and for
// AVX2. Both compile the same element-wise loops, so they give the same bits. Everything here has internal
// linkage, so that the linker cannot mix the two.
//
// A strip is computed from its first row to its last. Each input row is convolved horizontally into a ring of
// 11 rows. The vertical convolution of the ring gives the windows of the row 5 above. Their derivatives go
// through a second ring and give the gradient of the row 10 above. Channels are interleaved, so neighbouring
// taps are 3 floats apart in a row.
#pragma once
#include <algorithm>
#include <memory>

#include "loss/photometric.h"

namespace blitzgs::cpu {

constexpr int kStripRows = 48;

namespace {

constexpr int kPad = 3 * kSsimRadius;

// out [count] = the horizontal convolution of a row that is padded by kPad zeros on both sides.
template <class T> void convolve_row(const T* window, const T* padded, int64_t count, T* out) {
#pragma GCC ivdep
  for (int64_t i = 0; i < count; ++i) {
    const T* in = padded + i;
    T sum = window[5] * in[15];
    sum += window[4] * (in[12] + in[18]);
    sum += window[3] * (in[9] + in[21]);
    sum += window[2] * (in[6] + in[24]);
    sum += window[1] * (in[3] + in[27]);
    sum += window[0] * (in[0] + in[30]);
    out[i] = sum;
  }
}

template <class T> class PhotometricStrip {
 public:
  explicit PhotometricStrip(const PhotometricArgs<T>& args)
      : args_(args),
        count_(3 * int64_t(args.width)),
        padded_(count_ + 2 * kPad),
        buffer_(new T[7 * padded_ + (4 + 3) * (kSsimTaps + 1) * count_]()) {
    T* next = buffer_.get();
    for (T*& row : padded_rows_) row = next, next += padded_;
    for (T*& row : windows_) row = next, next += count_;
    for (auto& quantity : ring1_) {
      for (T*& row : quantity) row = next, next += count_;
    }
    for (auto& quantity : ring2_) {
      for (T*& row : quantity) row = next, next += count_;
    }
  }

  // Computes rows [begin, end) of one view: adds to the sums and writes the gradient.
  void run(int64_t view, int begin, int end, double* l1, double* ssim) {
    const bool gradient = args_.l1_weights != nullptr;
    const int reach = gradient ? kSsimRadius : 0;
    for (int row = begin - reach - kSsimRadius; row < end + reach + kSsimRadius; ++row) {
      absorb_input(view, row);
      const int centre = row - kSsimRadius;
      if (centre < begin - reach) continue;
      const bool inside = centre >= 0 && centre < args_.height;
      if (inside) compute_windows(view, centre);
      if (inside && args_.parts && centre >= begin && centre < end) add_sums(view, centre, l1, ssim);
      if (!gradient) continue;
      absorb_derivatives(centre, inside);
      if (centre - kSsimRadius >= begin) write_gradient(view, centre - kSsimRadius);
    }
  }

 private:
  static int slot(int row) { return (row + 4 * kSsimTaps) % kSsimTaps; }

  T target(int64_t at) const {
    return args_.targets ? args_.targets[at] : T(args_.targets_u8[at]) * (T(1) / T(255));
  }

  int64_t start_of(int64_t view, int row) const { return (view * args_.height + row) * count_; }

  void absorb_input(int64_t view, int row) {
    if (row < 0 || row >= args_.height) {
      for (auto& quantity : ring1_) std::fill_n(quantity[slot(row)], count_, T(0));
      return;
    }
    const int64_t start = start_of(view, row);
    const T* x = args_.renders + start;
    T *r0 = padded_rows_[0] + kPad, *r1 = padded_rows_[1] + kPad, *r2 = padded_rows_[2] + kPad,
      *r3 = padded_rows_[3] + kPad;
#pragma GCC ivdep
    for (int64_t i = 0; i < count_; ++i) r1[i] = target(start + i);
#pragma GCC ivdep
    for (int64_t i = 0; i < count_; ++i) {
      const T y = r1[i], difference = x[i] - y;
      r0[i] = x[i];
      r1[i] = difference;
      r2[i] = x[i] * x[i] + y * y;
      r3[i] = difference * difference;
    }
    for (int q = 0; q < 4; ++q) convolve_row(args_.window, padded_rows_[q], count_, ring1_[q][slot(row)]);
  }

  // Convolves one quantity vertically around a centre row.
  void gather(T* const (&ring)[kSsimTaps], int centre, T* out) const {
    const T* rows[kSsimTaps];
    for (int k = 0; k < kSsimTaps; ++k) rows[k] = ring[slot(centre - kSsimRadius + k)];
    const T *a = rows[0], *b = rows[1], *c = rows[2], *d = rows[3], *e = rows[4], *f = rows[5], *g = rows[6],
            *h = rows[7], *s = rows[8], *t = rows[9], *u = rows[10];
    const T w0 = args_.window[0], w1 = args_.window[1], w2 = args_.window[2], w3 = args_.window[3],
            w4 = args_.window[4], w5 = args_.window[5];
#pragma GCC ivdep
    for (int64_t i = 0; i < count_; ++i) {
      T sum = w5 * f[i];
      sum += w4 * (e[i] + g[i]);
      sum += w3 * (d[i] + h[i]);
      sum += w2 * (c[i] + s[i]);
      sum += w1 * (b[i] + t[i]);
      sum += w0 * (a[i] + u[i]);
      out[i] = sum;
    }
  }

  // Writes the SSIM of each pixel to windows_[0], and its derivatives, weighted and masked, to padded rows 4
  // to 6.
  void compute_windows(int64_t view, int centre) {
    for (int q = 0; q < 4; ++q) gather(ring1_[q], centre, windows_[q]);
    T *w0 = windows_[0], *w1 = windows_[1], *w2 = windows_[2], *w3 = windows_[3];
    if (!args_.l1_weights) {
#pragma GCC ivdep
      for (int64_t i = 0; i < count_; ++i) w0[i] = ssim_terms(w0[i], w1[i], w2[i], w3[i]).value;
      return;
    }
    T *m = padded_rows_[4] + kPad, *p = padded_rows_[5] + kPad, *q = padded_rows_[6] + kPad;
    const T weight = weight_of(args_, args_.ssim_weights, view);
#pragma GCC ivdep
    for (int64_t i = 0; i < count_; ++i) {
      const SsimTerms<T> terms = ssim_terms(w0[i], w1[i], w2[i], w3[i]);
      w0[i] = terms.value;
      m[i] = weight * terms.by_mean;
      p[i] = weight * terms.by_p;
      q[i] = weight * terms.by_q;
    }
    if (const uint8_t* mask = mask_row(view, centre)) {
      for (int64_t i = 0; i < count_; ++i) {
        if (!mask[i / 3]) m[i] = p[i] = q[i] = 0;
      }
    }
  }

  const uint8_t* mask_row(int64_t view, int row) const {
    return args_.masks ? args_.masks + (view * args_.height + row) * args_.width : nullptr;
  }

  // Adds the L1 and SSIM of the owned pixels of a row. Eight partial sums give the same order of additions
  // for every vector width.
  void add_sums(int64_t view, int centre, double* l1, double* ssim) const {
    const OwnedColumns owned = owned_columns(args_, view, centre);
    const int64_t start = start_of(view, centre);
    const uint8_t* mask = mask_row(view, centre);
    double differences[8] = {}, values[8] = {};
    const auto add = [&](int64_t i, int lane) {
      if (mask && !mask[i / 3]) return;
      differences[lane] += double(std::fabs(args_.renders[start + i] - target(start + i)));
      values[lane] += double(windows_[0][i]);
    };
    int64_t i = 3 * int64_t{owned.begin};
    const int64_t last = 3 * int64_t{owned.end};
    for (; i + 8 <= last; i += 8) {
      for (int lane = 0; lane < 8; ++lane) add(i + lane, lane);
    }
    for (int lane = 0; i < last; ++i, ++lane) add(i, lane);
    for (int lane = 0; lane < 8; ++lane) *l1 += differences[lane], *ssim += values[lane];
  }

  void absorb_derivatives(int centre, bool inside) {
    for (int q = 0; q < 3; ++q) {
      T* out = ring2_[q][slot(centre)];
      if (inside) {
        convolve_row(args_.window, padded_rows_[4 + q], count_, out);
      } else {
        std::fill_n(out, count_, T(0));
      }
    }
  }

  void write_gradient(int64_t view, int row) {
    const OwnedColumns owned = owned_columns(args_, view, row);
    for (int q = 0; q < 3; ++q) gather(ring2_[q], row, windows_[q]);
    const int64_t start = start_of(view, row);
    const T* x = args_.renders + start;
    T* out = args_.v_renders + start;
    const T *m = windows_[0], *p = windows_[1], *q = windows_[2];
    const T weight = weight_of(args_, args_.l1_weights, view);
    const uint8_t* mask = mask_row(view, row);
    const int64_t first = 3 * int64_t{owned.begin}, last = 3 * int64_t{owned.end};
    std::fill_n(out, first, T(0));
    std::fill_n(out + last, count_ - last, T(0));
#pragma GCC ivdep
    for (int64_t i = first; i < last; ++i) {
      const T difference = x[i] - target(start + i);
      const T sign = T((difference > 0) - (difference < 0));
      const T l1 = !mask || mask[i / 3] ? weight * sign : T(0);
      out[i] = l1 + m[i] + T(2) * (x[i] * p[i] + difference * q[i]);
    }
  }

  const PhotometricArgs<T>& args_;
  int64_t count_, padded_;
  std::unique_ptr<T[]> buffer_;
  T* padded_rows_[7];
  T* windows_[4];
  T* ring1_[4][kSsimTaps];
  T* ring2_[3][kSsimTaps];
};

// Computes strips[begin .. end). The sums of strip s are added to sums[2 s] (L1) and sums[2 s + 1] (SSIM).
template <class T>
void run_photometric_strips(const PhotometricArgs<T>& args, const int64_t* strips, int64_t begin, int64_t end,
                            double* sums) {
  PhotometricStrip<T> worker(args);
  const int64_t per_view = (args.height + kStripRows - 1) / kStripRows;
  for (int64_t i = begin; i < end; ++i) {
    const int64_t strip = strips[i];
    const int first = int(strip % per_view) * kStripRows;
    const int last = first + kStripRows < args.height ? first + kStripRows : args.height;
    worker.run(strip / per_view, first, last, sums + 2 * strip, sums + 2 * strip + 1);
  }
}

}  // namespace
}  // namespace blitzgs::cpu
