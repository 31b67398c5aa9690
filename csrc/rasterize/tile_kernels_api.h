// SPDX-License-Identifier: Apache-2.0
// The interface of the CPU tile kernels to the code that calls them: plain data without inline arithmetic,
// because the kernels are compiled with other instructions than their callers.
#pragma once
#include <cstddef>
#include <cstdint>

#include "importance/importance.h"
#include "rasterize/rasterize.h"

namespace blitzgs::cpu {

constexpr int kMaxTileSize = 64;    // the rows of a tile are the bits of a 64-bit word
constexpr int kPackedChannels = 5;  // channels that fit the cache line of a PreparedSplat

// The exponent of a splat is -(u^2 + w^2) with u = l11 dx + l21 dy, w = l22 dy. The factors l11, l21 and l22
// are multiplied by the root of this scale: float32 computes alpha as a power of 2, float64 as a power of e.
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

// A splat prepared for the kernels, one cache line in float32. It may touch pixels with u^2 + w^2 <= cut, in
// rows within half_height of y (-1: no row). In the row at dy, these pixels are centred on x - shear dy, with
// a half width of sqrt(cut - w^2) * inv_l11 + slack.
template <class T>
struct alignas(64) PreparedSplat {
  T x, y, l11, l21, l22, opacity, cut, inv_l11, shear, half_height, slack;
  T color[kPackedChannels];
};

// The layout of the state of a tile's pixels: planes of tile_size rows of `stride` pixels.
struct PlaneLayout {
  explicit PlaneLayout(int tile_size) : stride((tile_size + 15) / 8 * 8), plane(stride * tile_size) {}
  int stride, plane;
};

// The scratch numbers of a tile: two planes, one plane per channel, and a row of pixel centres.
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

// The layout of one splat's partial gradient from one tile: these six numbers, then D colours, then, with
// absgrad, two absolute sums.
enum PartialGradient { kMeanX, kMeanY, kConicA, kConicB, kConicC, kOpacity, kColor };
constexpr int partial_width(int n_channels, bool absgrad) { return kColor + n_channels + (absgrad ? 2 : 0); }

template <class T>
struct TileKernels {
  std::int32_t (*forward)(const TileJob<T>&);                      // returns the entries processed
  void (*backward)(const TileJob<T>&, T* partials);                // writes n_entries partial gradients
  void (*contribute)(const TileJob<T>&, const ContributionSums&);  // adds to the sums of all tiles
  void (*list_splats)(const TileJob<T>&, const PixelSplats<T>&);   // writes the rows of the tile's pixels
};

// Defined in common/kernels_avx2.cpp; call only where the processor has AVX2 and FMA.
TileKernels<float> avx2_tile_kernels(int n_channels, bool absgrad);

}  // namespace blitzgs::cpu
