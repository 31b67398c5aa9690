// SPDX-License-Identifier: Apache-2.0
// The photometric loss (docs/image.md, Loss; Kerbl et al. 2023, Eq. 7): fused L1 and SSIM (Wang et al. 2004)
// of rendered views against their images, and the gradient by the renders.
//
//   l1[b], ssim[b] = sums of |x - y| and of SSIM(x, y) over owned, unmasked pixels and channels
//
// x renders [B, H, W, 3]; y targets of the same shape, uint8 (value / 255) or the dtype of x; masks uint8
// [B, H, W], 0 = excluded from the sums (windows centred at other pixels still read the pixel). The caller
// divides by the number of pixels. Owned pixels are those of the tiles [tile_begin, tile_end) of the B views,
// tile index (b * tiles_y + ty) * tiles_x + tx; the forward reads x up to 5 pixels beyond them.
//
// The gradient is v_renders = d(sum_b l1_weights[b] l1[b] + ssim_weights[b] ssim[b]) / dx for the sums over
// ALL tiles. Each rank computes it for its owned pixels, reading x up to 10 pixels beyond them, so the
// gradients of all ranks together are the gradient of the whole. For other pixels v_renders is zero with
// clear_rest, otherwise zero or not written. The derivative of |x - y| at 0 is 0. With samples [B], the
// weights of view b are divided by samples[b]. The kernel also writes what one visible Gaussian weighs in two
// terms of the training loss (MeanTerms).
//
// SSIM is computed from four windowed quantities: mean(x), e = mean(x) - mean(y), P = E[x^2 + y^2] and
// Q = E[(x - y)^2]. With A = mean(x)^2 + mean(y)^2 + C1, V = Q - e^2 (the variance of x - y) and
// S = P - mean(x)^2 - mean(y)^2 + C2, it is SSIM = (1 - e^2 / A) (1 - V / S). The textbook quotient needs
// five, and cancels in flat regions (in float32 for values up to some 10).
//
// The sums are written in parts, double [B, K, 2], each over a fixed block of pixels in a fixed order; the op
// report (below) adds them up. The result repeats bit for bit for any number of threads.
#pragma once
#include "math/vec.h"

namespace blitzgs {

constexpr int kSsimRadius = 5;
constexpr int kSsimTaps = 2 * kSsimRadius + 1;

// Terms of the training loss that are means over the visible Gaussians of a view. One of n visible Gaussians
// weighs scale_reg = scale_weight / n and opacity_reg = opacity_weight / (B n); n is at least 1.
template <class T> struct MeanTerms {
  const int64_t* visible;  // [B]; null: no such terms
  T scale_weight, opacity_weight;
  T *scale_reg, *opacity_reg;  // [B]
};

template <class T> struct PhotometricArgs {
  const T* renders;
  const T* targets;  // null if the targets are uint8
  const uint8_t* targets_u8;
  const uint8_t* masks;   // null: all pixels count
  const T* l1_weights;    // [B]; null: no gradient
  const T* ssim_weights;  // [B]
  const T* samples;       // [B]; null: 1
  MeanTerms<T> means;
  double* parts;  // [B, K, 2], K of photometric_parts(); null: no sums
  T* v_renders;   // with l1_weights
  bool clear_rest;
  int64_t views;
  int width, height, tile_size, tiles_x, tiles_y;
  int64_t tile_begin, tile_end;
  T window[kSsimTaps];
};

// The owned columns [begin, end) of one pixel row. Tiles are a range, so they are one interval.
struct OwnedColumns {
  int begin, end;
};

template <class T>
BLITZGS_HD OwnedColumns owned_columns(const PhotometricArgs<T>& args, int64_t view, int row) {
  const int64_t first = (view * args.tiles_y + row / args.tile_size) * args.tiles_x;
  const int64_t begin = args.tile_begin - first, end = args.tile_end - first;
  const int64_t tiles = args.tiles_x;
  const int64_t b = begin < 0 ? 0 : (begin > tiles ? tiles : begin);
  const int64_t e = end < b ? b : (end > tiles ? tiles : end);
  const int64_t from = b * args.tile_size, to = e * args.tile_size;
  return {int(from < args.width ? from : args.width), int(to < args.width ? to : args.width)};
}

// The weight of a view: an entry of l1_weights or ssim_weights, divided by the view's samples.
template <class T> BLITZGS_HD T weight_of(const PhotometricArgs<T>& args, const T* weights, int64_t view) {
  return args.samples ? weights[view] / args.samples[view] : weights[view];
}

template <class T> BLITZGS_HD void write_mean_terms(const MeanTerms<T>& means, int64_t views, int64_t view) {
  const int64_t n = means.visible[view] > 1 ? means.visible[view] : 1;
  means.scale_reg[view] = means.scale_weight / T(n);
  // Rounded as torch rounds a number divided by a tensor, so that trainings repeat those of earlier versions.
  means.opacity_reg[view] = means.opacity_weight * (T(1) / T(views * n));
}

// One window: its SSIM and the derivatives by mean(x), P and Q.
template <class T> struct SsimTerms {
  T value, by_mean, by_p, by_q;
};

template <class T> BLITZGS_HD SsimTerms<T> ssim_terms(T mean_x, T e, T p, T q) {
  const T c1 = T(0.0001), c2 = T(0.0009);
  const T mean_y = mean_x - e;
  const T energy = mean_x * mean_x + mean_y * mean_y;
  const T inverse_a = reciprocal(energy + c1);
  const T inverse_s = reciprocal(p - energy + c2);
  const T u = e * inverse_a, w = (q - e * e) * inverse_s;
  const T luminance = T(1) - e * u, structure = T(1) - w;
  SsimTerms<T> terms;
  terms.value = luminance * structure;
  terms.by_mean = T(2) * (u * (u * mean_x - T(1)) * structure + luminance * inverse_s * (e - mean_x * w));
  terms.by_q = -luminance * inverse_s;
  terms.by_p = -terms.by_q * w;
  return terms;
}

// The report of a training step: the sums of the loss, added up from the parts that the photometric kernel
// wrote, and the costs of this rank's tiles. One launch writes the report to the memory of every rank that
// reads it. Parts are added in a fixed order. CPU and CUDA agree to the rounding of doubles.

constexpr int kMaxReportTargets = 16;

// The memory of one rank that gets the report, a peer's or this rank's own.
template <class T> struct ReportTarget {
  T* l1;     // [B]
  T* ssim;   // [B]
  T* tiles;  // [tiles], of which this rank's are written
};

template <class T> struct Report {
  const double* parts;  // [B, K, 2]
  int64_t views, n_parts;
  const int32_t* tile_work;  // [tiles]
  int64_t tile_begin, tile_end;
  ReportTarget<T> targets[kMaxReportTargets];
  int n_targets;
};

// The loss of views from the partial sums that the photometric kernel wrote, in one launch:
//   loss = offset + sum over i of (l1_weight parts[i][0] + ssim_weight parts[i][1]),  0 <= i < n.
// Parts are added in a fixed order. CPU and CUDA agree to the rounding of doubles.

template <class T> struct LossOfSums {
  const double* parts;
  int64_t n;
  double l1_weight, ssim_weight, offset;
  T* loss;
};

namespace BLITZGS_BACKEND {
template <class T> int64_t photometric_parts(const PhotometricArgs<T>& args);
template <class T> void photometric(const PhotometricArgs<T>& args, Workspace&, CudaStream);
template <class T> void loss_of_sums(const LossOfSums<T>&, CudaStream);
template <class T> void report(const Report<T>& report, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
