// SPDX-License-Identifier: Apache-2.0
// The CPU kernels of one tile, forward (tile_forward.h) and backward, over the lane types of math/lanes.h.
// They are compiled twice, plain and with AVX2; internal linkage keeps the two apart.
//
// A kernel takes the splats of the list one after the other, forward front to back, backward back to front.
// For each splat it visits the pixel rows that the splat's ellipse meets, and in a row eight pixels at a time
// from the first pixel inside the ellipse. The state of the pixels is in scratch planes that fit the
// first-level cache. Rows are padded so that eight pixels can be loaded from any pixel of the row.
#pragma once
#include <vector>

#include "rasterize/tile_forward.h"

namespace blitzgs::cpu {
namespace {

template <class T> struct BackwardState {
  PlaneLayout layout;
  T* transmittance;  // in front of the entries visited so far
  T* behind;         // v_renders . (the colour of those entries and the background, as seen with T = 1)
  T *v_render, *centres;
  int32_t* last;
  int32_t last_in_row[kMaxTileSize] = {};
};

template <int D, class T> BackwardState<T> start_backward(const TileJob<T>& tile) {
  const int n_channels = channels<D>(tile);
  auto state = start_planes<BackwardState<T>>(tile, n_channels);
  for (int row = 0; row < tile.height; ++row) {
    for (int x = 0; x < tile.width; ++x) {
      const int pixel = row * state.layout.stride + x;
      const int64_t in = tile.first_pixel + int64_t(row) * tile.image_width + x;
      state.transmittance[pixel] = tile.saved.transmittances[in];
      state.last[pixel] = tile.saved.last_ids[in];
      state.last_in_row[row] = std::max(state.last_in_row[row], state.last[pixel]);
      // The gradient of a pixel without splats reaches none, also if it is NaN, as of 1 / depth.
      if (state.last[pixel] == 0) continue;
      T behind = tile.saved.v_alphas ? -tile.saved.v_alphas[in] : T(0);
      for (int c = 0; c < n_channels; ++c) {
        const T v = tile.saved.v_renders[in * n_channels + c];
        state.v_render[c * state.layout.plane + pixel] = v;
        if (tile.background) behind += tile.background[c] * v;
      }
      state.behind[pixel] = behind;
    }
  }
  return state;
}

// The sums over the pixels of one splat in one tile, one partial sum per lane; g = alpha dL/dalpha.
template <class Lanes, bool kAbs> struct GradientSums {
  Lanes g = Lanes::zero(), gu = Lanes::zero(), gy = Lanes::zero();
  Lanes gxx = Lanes::zero(), gxy = Lanes::zero(), gyy = Lanes::zero();
  Lanes abs_x = Lanes::zero(), abs_y = Lanes::zero();
};

// Differentiates one entry at eight pixels of a row: adds to its sums and v_color, and updates the pixels.
template <class Lanes, int D, bool kAbs, class T>
inline void differentiate(const TileJob<T>& tile, const PreparedSplat<T>& splat, const T* splat_colors,
                          const RowSpans<T>& spans, int32_t entry, int row, int x, BackwardState<T>& state,
                          GradientSums<Lanes, kAbs>& sums, Lanes* v_color) {
  const int pixel = row * state.layout.stride + x;
  const auto composited =
      Lanes::Int::greater(Lanes::Int::load(state.last + pixel), Lanes::Int::broadcast(entry));
  if (!composited.any()) return;
  const Lanes dx = Lanes::load(state.centres + x) - Lanes::broadcast(splat.x);
  const Lanes u = Lanes::fma(Lanes::broadcast(splat.l11), dx, Lanes::broadcast(spans.shift[row]));
  const Lanes weight = falloff(Lanes::fnma(u, u, Lanes::broadcast(spans.minus_w2[row])));
  const Lanes raw = Lanes::broadcast(splat.opacity) * weight;
  const Lanes alpha = Lanes::min(Lanes::broadcast(T(kAlphaMax)), raw);
  const auto drawn = composited & Lanes::greater_equal(alpha, Lanes::broadcast(T(kAlphaCut)));
  const Lanes after = Lanes::load(state.transmittance + pixel);
  const Lanes before = after / (Lanes::broadcast(T(1)) - alpha);
  Lanes::select(drawn, before, after).store(state.transmittance + pixel);
  const Lanes share = Lanes::keep(drawn, alpha * before);
  Lanes own = Lanes::zero();  // v_renders . colour of the splat
  for (int c = 0; c < channels<D>(tile); ++c) {
    const Lanes v = Lanes::load(state.v_render + c * state.layout.plane + pixel);
    own = Lanes::fma(v, Lanes::broadcast(splat_colors[c]), own);
    v_color[c] = Lanes::fma(share, v, v_color[c]);
  }
  const Lanes behind = Lanes::load(state.behind + pixel);
  const Lanes gain = own - behind;  // dL/dalpha = T gain
  Lanes::select(drawn, Lanes::fma(alpha, gain, behind), behind).store(state.behind + pixel);
  const auto unclipped = Lanes::greater_equal(Lanes::broadcast(T(kAlphaMax)), raw);
  const Lanes g = Lanes::keep(unclipped, share * gain);
  const Lanes dy = Lanes::broadcast(spans.dy[row]);
  const Lanes gx = g * dx, gy = g * dy, gu = g * u;
  sums.g = sums.g + g;
  sums.gu = sums.gu + gu;
  sums.gy = sums.gy + gy;
  sums.gxx = Lanes::fma(gx, dx, sums.gxx);
  sums.gxy = Lanes::fma(gx, dy, sums.gxy);
  sums.gyy = Lanes::fma(gy, dy, sums.gyy);
  if constexpr (kAbs) {
    sums.abs_x = sums.abs_x + Lanes::abs(gu);
    const Lanes v_y =
        Lanes::fma(Lanes::broadcast(splat.l21), gu, Lanes::broadcast(splat.l22 * splat.l22) * gy);
    sums.abs_y = sums.abs_y + Lanes::abs(v_y);
  }
}

// Turns the sums of one splat in one tile into its partial gradient, in the order of PartialGradient.
template <class Lanes, bool kAbs, class T>
void write_partial(const PreparedSplat<T>& splat, const GradientSums<Lanes, kAbs>& sums, const Lanes* v_color,
                   int n_channels, T* partial) {
  constexpr T kInverse = T(1) / kExponentScale<T>;
  const T gu = sums.gu.sum() * kInverse, gy = sums.gy.sum() * kInverse;
  partial[kMeanX] = splat.l11 * gu;
  partial[kMeanY] = splat.l21 * gu + splat.l22 * splat.l22 * gy;
  partial[kConicA] = T(-0.5) * sums.gxx.sum();
  partial[kConicB] = -sums.gxy.sum();
  partial[kConicC] = T(-0.5) * sums.gyy.sum();
  partial[kOpacity] = sums.g.sum() / splat.opacity;
  for (int c = 0; c < n_channels; ++c) partial[kColor + c] = v_color[c].sum();
  if constexpr (kAbs) {
    partial[kColor + n_channels] = splat.l11 * (sums.abs_x.sum() * kInverse);
    partial[kColor + n_channels + 1] = sums.abs_y.sum() * kInverse;
  }
}

// The gradient of compositing one tile: writes the partial gradient of each of the first n_entries entries to
// partials [n_entries, partial_width]. n_entries must be at least the largest of the tile's last_ids.
template <class Lanes, int D, bool kAbs>
void backward_tile(const TileJob<typename Lanes::Scalar>& tile, typename Lanes::Scalar* partials) {
  using T = typename Lanes::Scalar;
  BackwardState<T> state = start_backward<D>(tile);
  RowSpans<T> spans;
  const int n_channels = channels<D>(tile), width = partial_width(n_channels, kAbs);
  std::vector<Lanes> many(D > 0 ? 0 : n_channels);
  for (int32_t entry = tile.n_entries - 1; entry >= 0; --entry) {
    __builtin_prefetch(tile.splats + tile.list[std::max(entry - kPrefetchDistance, 0)]);
    const PreparedSplat<T>& splat = tile.splats[tile.list[entry]];
    const T* color = splat_color<D>(tile, tile.list[entry]);
    GradientSums<Lanes, kAbs> sums;
    Lanes few[D > 0 ? D : 1];
    Lanes* v_color = D > 0 ? few : many.data();
    std::fill_n(v_color, n_channels, Lanes::zero());
    uint64_t rows = find_spans<Lanes>(splat, tile, spans);
    for (; rows; rows &= rows - 1) {
      const int row = std::countr_zero(rows);
      if (state.last_in_row[row] <= entry) continue;
      for (int x = spans.first[row]; x <= spans.last[row]; x += kLanes) {
        differentiate<Lanes, D, kAbs>(tile, splat, color, spans, entry, row, x, state, sums, v_color);
      }
    }
    write_partial(splat, sums, v_color, n_channels, partials + int64_t(entry) * width);
  }
}

// D: the number of channels; 0: any.
template <class Lanes, int D> TileKernels<typename Lanes::Scalar> kernels_of(bool absgrad) {
  return {forward_tile<Lanes, D>, absgrad ? backward_tile<Lanes, D, true> : backward_tile<Lanes, D, false>,
          contribute_tile<Lanes>, list_tile_splats<Lanes>};
}

template <class Lanes> TileKernels<typename Lanes::Scalar> select_kernels(int n_channels, bool absgrad) {
  const auto kernels = n_channels == 3   ? kernels_of<Lanes, 3>
                       : n_channels == 4 ? kernels_of<Lanes, 4>
                                         : kernels_of<Lanes, 0>;
  return kernels(absgrad);
}

}  // namespace
}  // namespace blitzgs::cpu
