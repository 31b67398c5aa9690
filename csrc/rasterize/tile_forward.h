// SPDX-License-Identifier: Apache-2.0
// Compositing one tile on the CPU, front to back (docs/image.md, sections 3 and 5). A sink takes the weights
// alpha T: ColorSink makes the image, ContributionSink the contributions of splats, PixelSink those of
// pixels. Compiled twice, plain and with AVX2 (tile_kernels.h); they share plain data alone.
#pragma once
#include <algorithm>
#include <atomic>

#include "importance/importance.h"
#include "math/lanes.h"

namespace blitzgs::cpu {

constexpr int kMaxTileSize = 64;    // the rows of a tile are the bits of a 64-bit word
constexpr int kPackedChannels = 5;  // channels that fit the cache line of a PreparedSplat

// The exponent of a splat is -(u^2 + w^2) with u = l11 dx + l21 dy, w = l22 dy. The factors l11, l21 and l22
// are multiplied by the root of this scale: float32 computes alpha as a power of 2, float64 as a power of e.
template <class T>
constexpr T kExponentScale = sizeof(T) == 4 ? T(0.72134752044448170f) : T(0.5);  // log2(e) / 2, or 1 / 2

// A splat prepared for the kernels, one cache line in float32. It may touch pixels with u^2 + w^2 <= cut, in
// rows within half_height of y (-1: no row). In the row at dy, these pixels are centred on x - shear dy, with
// a half width of sqrt(cut - w^2) * inv_l11 + slack.
template <class T> struct alignas(64) PreparedSplat {
  T x, y, l11, l21, l22, opacity, cut, inv_l11, shear, half_height, slack;
  T color[kPackedChannels];
};

// The layout of the state of a tile's pixels: planes of tile_size rows of `stride` pixels.
struct PlaneLayout {
  explicit PlaneLayout(int tile_size) : stride((tile_size + 15) / 8 * 8), plane(stride * tile_size) {}
  int stride, plane;
};

// The scratch numbers of a tile: two planes, one plane per channel, and a row of pixel centres.
inline size_t tile_memory(int tile_size, int n_channels) {
  const PlaneLayout layout(tile_size);
  return size_t(layout.plane) * (2 + n_channels) + layout.stride;
}

template <class T> struct TileJob {
  const PreparedSplat<T>* splats;
  const T* colors;      // [P, D], for more than kPackedChannels channels
  const T* background;  // [D] or null
  const int32_t* list;
  int32_t n_entries;
  int n_channels, tile_size;
  int x0, y0, width, height;  // the tile's pixels within the image
  int image_width;
  int64_t first_pixel;      // index of (x0, y0) in [B, H, W]
  RasterizeOutput<T> out;   // forward
  RasterizeSaved<T> saved;  // backward
  T* memory;                // tile_memory() numbers
  int32_t* last_memory;     // PlaneLayout::plane numbers
};

// The layout of one splat's partial gradient from one tile: these six numbers, then D colours, then, with
// absgrad, two absolute sums.
enum PartialGradient { kMeanX, kMeanY, kConicA, kConicB, kConicC, kOpacity, kColor };
constexpr int partial_width(int n_channels, bool absgrad) { return kColor + n_channels + (absgrad ? 2 : 0); }

template <class T> struct TileKernels {
  int32_t (*forward)(const TileJob<T>&);                           // returns the entries processed
  void (*backward)(const TileJob<T>&, T* partials);                // writes n_entries partial gradients
  void (*contribute)(const TileJob<T>&, const ContributionSums&);  // adds to the sums of all tiles
  void (*list_splats)(const TileJob<T>&, const PixelSplats<T>&);   // writes the rows of the tile's pixels
};

// Defined in common/kernels_avx2.cpp; call only where the processor has AVX2 and FMA.
TileKernels<float> avx2_tile_kernels(int n_channels, bool absgrad);

namespace {

template <class Lanes> Lanes falloff(Lanes exponent) {
  if constexpr (sizeof(typename Lanes::Scalar) == 4) {
    return exp2_nonpositive(exponent);
  } else {
    return Lanes::make([&](int i) { return std::exp(exponent.v[i]); });
  }
}

// A splat on each pixel row of a tile: the exponent of alpha at (dx, row) is -(l11 dx + shift)^2 + minus_w2,
// and the splat may touch pixels [first, last] of the row.
template <class T> struct RowSpans {
  alignas(32) T dy[kMaxTileSize];
  alignas(32) T shift[kMaxTileSize];
  alignas(32) T minus_w2[kMaxTileSize];
  alignas(32) int32_t first[kMaxTileSize];
  alignas(32) int32_t last[kMaxTileSize];
};

// Fills spans and returns the rows that the splat may touch, one bit each.
template <class Lanes, class T>
uint64_t find_spans(const PreparedSplat<T>& splat, const TileJob<T>& tile, RowSpans<T>& spans) {
  const T top = T(tile.y0) + T(0.5);
  const T low = splat.y - splat.half_height - top, high = splat.y + splat.half_height - top;
  const T bottom = T(tile.height - 1);
  const int row_begin = low > T(0) ? int(low < bottom ? low : bottom) / kLanes * kLanes : 0;
  const int row_end = high >= T(0) ? int(high < bottom ? high : bottom) + 1 : 0;
  const Lanes cut = Lanes::broadcast(splat.cut), zero = Lanes::zero();
  const Lanes right = Lanes::broadcast(T(tile.width - 1));
  const Lanes middle = Lanes::broadcast(splat.x - (T(tile.x0) + T(0.5)));
  uint64_t rows = 0;
  for (int row = row_begin; row < row_end; row += kLanes) {
    const Lanes dy = Lanes::broadcast(top + T(row)) + Lanes::iota() - Lanes::broadcast(splat.y);
    const Lanes w = Lanes::broadcast(splat.l22) * dy;
    const Lanes w2 = w * w;
    const Lanes rest = cut - w2;
    const Lanes reach = Lanes::fma(Lanes::sqrt(Lanes::max(rest, zero)), Lanes::broadcast(splat.inv_l11),
                                   Lanes::broadcast(splat.slack));
    const Lanes centre = Lanes::fnma(Lanes::broadcast(splat.shear), dy, middle);
    const Lanes first = Lanes::ceil(Lanes::max(centre - reach, zero));
    const Lanes last = Lanes::floor(Lanes::min(centre + reach, right));
    dy.store(spans.dy + row);
    (Lanes::broadcast(splat.l21) * dy).store(spans.shift + row);
    (zero - w2).store(spans.minus_w2 + row);
    first.to_int().store(spans.first + row);
    last.to_int().store(spans.last + row);
    const auto reached = Lanes::greater_equal(last, first) & Lanes::greater_equal(rest, zero);
    rows |= uint64_t(reached.bits()) << row;
  }
  return rows;
}

// The number of channels: D if D > 0, else that of the tile.
template <int D, class T> int channels(const TileJob<T>& tile) {
  if constexpr (D > 0) return D;
  return tile.n_channels;
}

template <int D, class T> const T* splat_color(const TileJob<T>& tile, int32_t index) {
  if constexpr (D > 0 && D <= kPackedChannels) return tile.splats[index].color;
  return tile.colors + int64_t(index) * channels<D>(tile);
}

// The state of a tile's pixels in its memory: planes of zeros, and the pixel centres of a row.
template <class State, class T> State start_planes(const TileJob<T>& tile, int n_channels) {
  const PlaneLayout layout(tile.tile_size);
  const ptrdiff_t plane = layout.plane, used = plane * (2 + n_channels);
  T* memory = tile.memory;
  std::fill_n(memory, used, T(0));
  std::fill_n(tile.last_memory, plane, 0);
  for (int x = 0; x < layout.stride; ++x) memory[used + x] = T(tile.x0 + x) + T(0.5);
  return {layout, memory, memory + plane, memory + 2 * plane, memory + used, tile.last_memory};
}

template <class T> struct ForwardState {
  PlaneLayout layout;
  T *transmittance, *ended, *color, *centres;
  int32_t* last;
  uint64_t alive_rows = 0;
  int32_t alive_in_row[kMaxTileSize] = {};
};

template <int D, class T> ForwardState<T> start_forward(const TileJob<T>& tile) {
  auto state = start_planes<ForwardState<T>>(tile, channels<D>(tile));
  for (int row = 0; row < tile.height; ++row) {
    std::fill_n(state.transmittance + row * state.layout.stride, tile.width, T(1));
    state.alive_in_row[row] = tile.width;
    state.alive_rows |= uint64_t{1} << row;
  }
  return state;
}

// Ends pixels x + i of a row, for each bit i of `bits`. A pixel that has not ended has transmittance > 0 (it
// starts at 1 and stays above the minimum). For a pixel that ends, the transmittance moves to `ended`, and a
// transmittance of 0 marks it as ended.
template <class T> void end_pixels(ForwardState<T>& state, int row, int x, unsigned bits) {
  for (; bits; bits &= bits - 1) {
    const int pixel = row * state.layout.stride + x + std::countr_zero(bits);
    state.ended[pixel] = state.transmittance[pixel];
    state.transmittance[pixel] = T(0);
    if (--state.alive_in_row[row] == 0) state.alive_rows &= ~(uint64_t{1} << row);
  }
}

// Composites a splat at eight pixels of a row and gives the sink their weights alpha T, zero for pixels at
// which the splat is not composited.
template <class Lanes, class T, class Sink>
inline void composite(const PreparedSplat<T>& splat, const RowSpans<T>& spans, int32_t entry, int row, int x,
                      ForwardState<T>& state, Sink& sink) {
  const int pixel = row * state.layout.stride + x;
  const Lanes before = Lanes::load(state.transmittance + pixel);
  const auto running = Lanes::greater(before, Lanes::zero());
  if (!running.any()) return;
  const Lanes dx = Lanes::load(state.centres + x) - Lanes::broadcast(splat.x);
  const Lanes u = Lanes::fma(Lanes::broadcast(splat.l11), dx, Lanes::broadcast(spans.shift[row]));
  const Lanes weight = falloff(Lanes::fnma(u, u, Lanes::broadcast(spans.minus_w2[row])));
  const Lanes alpha = Lanes::min(Lanes::broadcast(T(kAlphaMax)), Lanes::broadcast(splat.opacity) * weight);
  const auto touched = running & Lanes::greater_equal(alpha, Lanes::broadcast(T(kAlphaCut)));
  const Lanes after = before * (Lanes::broadcast(T(1)) - alpha);
  const auto drawn = touched & Lanes::greater_equal(after, Lanes::broadcast(T(kMinTransmittance)));
  sink.add(Lanes::keep(drawn, alpha * before), pixel);
  Lanes::select(drawn, after, before).store(state.transmittance + pixel);
  int32_t* last = state.last + pixel;
  Lanes::Int::select(drawn, Lanes::Int::broadcast(entry + 1), Lanes::Int::load(last)).store(last);
  const auto ending = touched.and_not(drawn);
  if (ending.any()) end_pixels(state, row, x, ending.bits());
}

template <int D, class T> void write_pixels(const TileJob<T>& tile, const ForwardState<T>& state) {
  for (int row = 0; row < tile.height; ++row) {
    for (int x = 0; x < tile.width; ++x) {
      const int pixel = row * state.layout.stride + x;
      const int64_t out = tile.first_pixel + int64_t(row) * tile.image_width + x;
      const T running = state.transmittance[pixel];
      const T rest = running > T(0) ? running : state.ended[pixel];
      tile.out.transmittances[out] = rest;
      tile.out.last_ids[out] = state.last[pixel];
      T* render = tile.out.renders + out * channels<D>(tile);
      for (int c = 0; c < channels<D>(tile); ++c) {
        const T background = tile.background ? tile.background[c] : T(0);
        render[c] = state.color[c * state.layout.plane + pixel] + rest * background;
      }
    }
  }
}

// The hardware cannot predict which splats a list names, so the loops prefetch splats this many entries
// ahead. Both loops contain the prefetch itself, because gcc drops calls of a function that only prefetches.
constexpr int32_t kPrefetchDistance = 6;

// Composites the tile's list and returns the number of entries processed. For each entry it calls
// sink.begin(splat), then sink.add(alpha T of eight pixels, the first of these pixels) for the pixels that
// the splat may touch, then sink.end(splat).
template <class Lanes, class T, class Sink>
int32_t composite_list(const TileJob<T>& tile, ForwardState<T>& state, Sink& sink) {
  RowSpans<T> spans;
  int32_t entry = 0;
  for (; entry < tile.n_entries && state.alive_rows; ++entry) {
    __builtin_prefetch(tile.splats + tile.list[std::min(entry + kPrefetchDistance, tile.n_entries - 1)]);
    const int32_t index = tile.list[entry];
    const PreparedSplat<T>& splat = tile.splats[index];
    sink.begin(index);
    uint64_t rows = find_spans<Lanes>(splat, tile, spans) & state.alive_rows;
    for (; rows; rows &= rows - 1) {
      const int row = std::countr_zero(rows);
      for (int x = spans.first[row]; x <= spans.last[row]; x += kLanes) {
        composite<Lanes>(splat, spans, entry, row, x, state, sink);
      }
    }
    sink.end(index);
  }
  return entry;
}

// Sums the colours of the splats, times their weights, in planes of pixels [D, plane].
template <class Lanes, int D, class T> struct ColorSink {
  const TileJob<T>& tile;
  T* planes;
  ptrdiff_t plane;
  const T* color = nullptr;

  void begin(int32_t index) { color = splat_color<D>(tile, index); }
  void add(Lanes share, int pixel) const {
    for (int c = 0; c < channels<D>(tile); ++c) {
      T* sum = planes + c * plane + pixel;
      Lanes::fma(share, Lanes::broadcast(color[c]), Lanes::load(sum)).store(sum);
    }
  }
  void end(int32_t) const {}
};

// Composites one tile of the image and writes its pixels. Returns the number of entries processed.
template <class Lanes, int D> int32_t forward_tile(const TileJob<typename Lanes::Scalar>& tile) {
  using T = typename Lanes::Scalar;
  ForwardState<T> state = start_forward<D>(tile);
  ColorSink<Lanes, D, T> sink{tile, state.color, state.layout.plane};
  const int32_t entries = composite_list<Lanes>(tile, state, sink);
  write_pixels<D>(tile, state);
  return entries;
}

// Sums the weights alpha T, their squares if these are wanted, and the pixels of each splat. The summands are
// integers in units of 2^-32, so that the order of the tiles does not change the sums.
template <class Lanes, class T> struct ContributionSink {
  const ContributionSums& sums;
  int64_t weight = 0, squares = 0;
  int32_t pixels = 0;

  void begin(int32_t) { weight = squares = pixels = 0; }
  void add(Lanes share, int) {
    alignas(64) T shares[kLanes];
    share.store(shares);
    for (const T alpha_t : shares) {
      const auto units = uint64_t(std::llrint(alpha_t * T(kContributionScale)));
      weight += int64_t(units);
      if (sums.squares) squares += int64_t(units * units >> 32);
      pixels += alpha_t > T(0);
    }
  }
  void end(int32_t index) const {
    if (pixels == 0) return;
    std::atomic_ref(sums.weights[index]).fetch_add(weight, std::memory_order_relaxed);
    std::atomic_ref(sums.pixels[index]).fetch_add(pixels, std::memory_order_relaxed);
    if (sums.squares) std::atomic_ref(sums.squares[index]).fetch_add(squares, std::memory_order_relaxed);
  }
};

template <class Lanes>
void contribute_tile(const TileJob<typename Lanes::Scalar>& tile, const ContributionSums& sums) {
  using T = typename Lanes::Scalar;
  ForwardState<T> state = start_forward<0>(tile);
  ContributionSink<Lanes, T> sink{sums};
  composite_list<Lanes>(tile, state, sink);
}

template <class Lanes, class T> struct PixelSink {
  const TileJob<T>& tile;
  const ForwardState<T>& state;
  const PixelSplats<T>& out;
  int32_t id = 0;

  void begin(int32_t index) { id = index; }
  void add(Lanes share, int pixel) const {
    alignas(64) T shares[kLanes];
    share.store(shares);
    const int y = pixel / state.layout.stride, x = pixel % state.layout.stride;
    for (int i = 0; i < kLanes; ++i) {
      if (!(shares[i] > T(0))) continue;
      const int64_t row = row_of(out, tile.first_pixel + int64_t(y) * tile.image_width + x + i);
      if (row < 0) continue;
      // The transmittance is still that in front of the splat.
      if (state.transmittance[pixel + i] > T(kMedianTransmittance)) out.medians[row] = id;
      const int32_t count = out.counts[row]++;
      if (out.strongest > 0) {
        const int64_t first = row * out.strongest;
        keep_strongest(out.ids + first, out.weights + first, out.strongest, count, id, shares[i]);
      }
    }
  }
  void end(int32_t) const {}
};

template <class Lanes>
void list_tile_splats(const TileJob<typename Lanes::Scalar>& tile,
                      const PixelSplats<typename Lanes::Scalar>& out) {
  using T = typename Lanes::Scalar;
  ForwardState<T> state = start_forward<0>(tile);
  const auto for_rows = [&](auto&& write) {
    for (int y = 0; y < tile.height; ++y) {
      for (int x = 0; x < tile.width; ++x) {
        const int64_t row = row_of(out, tile.first_pixel + int64_t(y) * tile.image_width + x);
        if (row >= 0) write(row, y * state.layout.stride + x);
      }
    }
  };
  for_rows([&](int64_t row, int) {
    out.counts[row] = 0;
    out.medians[row] = -1;
  });
  PixelSink<Lanes, T> sink{tile, state, out};
  composite_list<Lanes>(tile, state, sink);
  for_rows([&](int64_t row, int pixel) {
    const T running = state.transmittance[pixel];
    out.transmittances[row] = running > T(0) ? running : state.ended[pixel];
    for (int64_t k = out.counts[row]; k < out.strongest; ++k) {
      out.ids[row * out.strongest + k] = -1;
      out.weights[row * out.strongest + k] = T(0);
    }
  });
}

}  // namespace
}  // namespace blitzgs::cpu
