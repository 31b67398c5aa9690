// SPDX-License-Identifier: Apache-2.0
// What the tile kernels share with the code that drives them: plain data, no inline arithmetic.
#pragma once
#include <cstddef>
#include <cstdint>

#include "importance/importance.h"
#include "rasterize/rasterize.h"

namespace blitzgs::cpu {

constexpr int kMaxTileSize = 64;    // rows of a tile are the bits of a word
constexpr int kPackedChannels = 5;  // what a cache line has room for

// The exponent of a splat is -(u^2 + w^2) with u = l11 dx + l21 dy, w = l22 dy; its factors carry the root of
// this scale. float32 works in powers of two.
template <class T>
struct ExponentScale;
template <>
struct ExponentScale<float> {
  static constexpr float value = 0.72134752044448170f;  // log2(e) / 2
};
template <>
struct ExponentScale<double> {
  static constexpr double value = 0.5;
};

// A splat prepared for the kernels, one cache line in float32. Drawn where u^2 + w^2 <= cut, in rows within
// half_height of y (-1: nowhere); a chord at dy is centred on x - shear dy and reaches
// sqrt(cut - w^2) * inv_l11 + slack.
template <class T>
struct alignas(64) PreparedSplat {
  T x, y, l11, l21, l22, opacity, cut, inv_l11, shear, half_height, slack;
  T color[kPackedChannels];
};

// The state of a tile's pixels: planes of tile_size rows of `stride` pixels.
struct PlaneLayout {
  explicit PlaneLayout(int tile_size) : stride((tile_size + 15) / 8 * 8), plane(stride * tile_size) {}
  int stride, plane;
};

// Two planes, one per channel, and a row of pixel centres.
inline std::size_t tile_memory(int tile_size, int n_channels) {
  const PlaneLayout layout(tile_size);
  return static_cast<std::size_t>(layout.plane) * (2 + n_channels) + layout.stride;
}

template <class T>
struct TileJob {
  const PreparedSplat<T>* splats;
  const T* colors;      // [P, D], for more than kPackedChannels channels
  const T* background;  // [D] or null
  const std::int32_t* list;
  std::int32_t n_entries;
  int n_channels, tile_size;
  int x0, y0, width, height;  // the tile's pixels within the image
  int image_width;
  std::int64_t first_pixel;   // index of (x0, y0) in [B, H, W]
  RasterizeOutput<T> out;     // forward
  RasterizeSaved<T> saved;    // backward
  T* memory;                  // tile_memory() numbers
  std::int32_t* last_memory;  // PlaneLayout::plane numbers
};

// Layout of one splat's partial gradient from one tile: these, then D colours, then two absolute sums.
enum PartialGradient { kMeanX, kMeanY, kConicA, kConicB, kConicC, kOpacity, kColor };
constexpr int partial_width(int n_channels, bool absgrad) { return kColor + n_channels + (absgrad ? 2 : 0); }

template <class T>
struct TileKernels {
  std::int32_t (*forward)(const TileJob<T>&);                      // returns the entries processed
  void (*backward)(const TileJob<T>&, T* partials);                // writes n_entries partial gradients
  void (*contribute)(const TileJob<T>&, const ContributionSums&);  // adds to them, as other tiles do
};

// Defined in rasterize_avx2.cpp; call only where the processor has AVX2 and FMA.
TileKernels<float> avx2_tile_kernels(int n_channels, bool absgrad);

}  // namespace blitzgs::cpu
