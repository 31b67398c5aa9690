// SPDX-License-Identifier: Apache-2.0
// What the CUDA rasteriser's forward and backward share: packed rows, the arithmetic of alpha, and how a
// block reads a batch of its tile's list.
//
// A block is a tile, a warp an 8x4 subtile of it, a lane a pixel. The block fetches the list in batches; each
// thread tests its entry against every subtile, and the ballots of those tests tell each warp which entries
// it has to look at: a splat of a few pixels touches three of the eight subtiles of a 16x16 tile. The test is
// conservative, so it changes no pixel.
#pragma once
#include <cstdint>

#include "common/cuda_check.h"
#include "rasterize/rasterize.h"

namespace blitzgs::cuda {

inline constexpr unsigned kFullWarp = 0xffffffffu;
inline constexpr float kLog2Cut = -7.99435343685886f;    // log2(1/255)
inline constexpr float kFactorScale = 0.849321800288f;   // sqrt(log2(e) / 2)
inline constexpr float kInverseScale2 = 1.38629436112f;  // 1 / kFactorScale^2
inline constexpr int kSubtileWidth = 8, kSubtileHeight = 4;

// A row as the kernels read it: one 32-byte sector, so a gather moves no byte it does not use. With
// conic = L^T L (factor_conic), l11, l21, l22 are scaled by sqrt(log2(e) / 2), so that
// log2(alpha) = log2_opacity - (l11 dx + l21 dy)^2 - (l22 dy)^2.
struct __align__(32) PackedRow {
  float x, y, l11, l21;
  float l22, log2_opacity;
  float dx_per_dy;  // where alpha peaks along a row of pixels: dx = dx_per_dy * dy
  float dy_per_dx;  // and along a column
};

// Gradients of one row: v_mean2d x y, v_conic a b | v_conic c, v_opacity, v_color 0 1 | v_color 2 3, v_abs x
// y.
struct __align__(16) PackedGradient {
  float4 quads[3];
};

// aux: PackedRow [P], then float4 [P] colors when there are at most 4 channels.
inline const PackedRow* aux_rows(const void* aux) { return static_cast<const PackedRow*>(aux); }
inline const float4* aux_colors(const void* aux, std::int64_t n_rows) {
  return reinterpret_cast<const float4*>(aux_rows(aux) + n_rows);
}

// The channels of one launch: up to 4 of n_channels, from `first`.
struct ChannelChunk {
  const float4* packed;  // colors of aux, or null
  const float* colors;   // [P, n_channels] otherwise
  int n_channels, first, count;
};

__device__ __forceinline__ float4 load_color(const ChannelChunk& chunk, std::int32_t row) {
  if (chunk.packed) return __ldg(chunk.packed + row);
  const float* color = chunk.colors + static_cast<std::int64_t>(row) * chunk.n_channels + chunk.first;
  float4 c{color[0], 0.f, 0.f, 0.f};
  if (chunk.count > 1) c.y = color[1];
  if (chunk.count > 2) c.z = color[2];
  if (chunk.count > 3) c.w = color[3];
  return c;
}

__device__ __forceinline__ float channel(const float4& c, int k) {
  return k == 0 ? c.x : k == 1 ? c.y : k == 2 ? c.z : c.w;
}

__device__ __forceinline__ float exp2_approx(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

__device__ __forceinline__ float reciprocal_approx(float x) {
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

// log2 of the unclipped alpha at offset (dx, dy) = pixel - mean. Written out with the fused operations,
// because forward and backward must agree bit by bit on which pixels a row touches.
__device__ __forceinline__ float log2_alpha(float l11, float l21, float l22, float log2_opacity, float dx,
                                            float dy) {
  const float u = __fmaf_rn(l11, dx, __fmul_rn(l21, dy));
  const float v = __fmul_rn(l22, dy);
  return __fmaf_rn(-u, u, __fmaf_rn(-v, v, log2_opacity));
}

template <int TILE>
struct Tile {
  static constexpr int kThreads = TILE * TILE;
  static constexpr int kWarps = kThreads / 32;
  static constexpr int kColumns = TILE / kSubtileWidth;
};

// Where a thread's pixel lies.
struct Pixel {
  int x, y;            // in the image
  int left, top;       // of the subtile
  bool inside;         // of the image
  std::int64_t index;  // (camera, y, x) flattened
  float centre_x, centre_y;
};

struct TilePlace {
  std::int64_t tile;
  int camera, left, top;
};

template <int TILE>
__device__ __forceinline__ TilePlace locate_tile(const TileGrid& grid) {
  TilePlace place;
  place.tile = grid.tile_begin + blockIdx.x;
  place.camera = static_cast<int>(place.tile / grid.per_image());
  const int in_image = static_cast<int>(place.tile - place.camera * grid.per_image());
  place.top = in_image / grid.tiles_x * TILE;
  place.left = in_image % grid.tiles_x * TILE;
  return place;
}

template <int TILE>
__device__ __forceinline__ Pixel locate_pixel(const TileGrid& grid, const TilePlace& place, int warp,
                                              int lane) {
  Pixel pixel;
  pixel.left = place.left + warp % Tile<TILE>::kColumns * kSubtileWidth;
  pixel.top = place.top + warp / Tile<TILE>::kColumns * kSubtileHeight;
  pixel.x = pixel.left + lane % kSubtileWidth;
  pixel.y = pixel.top + lane / kSubtileWidth;
  pixel.inside = pixel.x < grid.width && pixel.y < grid.height;
  pixel.index = (static_cast<std::int64_t>(place.camera) * grid.height + pixel.y) * grid.width + pixel.x;
  pixel.centre_x = static_cast<float>(pixel.x) + 0.5f;
  pixel.centre_y = static_cast<float>(pixel.y) + 0.5f;
  return pixel;
}

__device__ __forceinline__ float clamp_between(float value, float low, float high) {
  return fminf(fmaxf(value, low), high);
}

// One bit per subtile: can alpha reach 1/255 at one of its pixel centres? The quadratic form is convex, so
// over a rectangle its least value is the better of the nearest row's and the nearest column's.
template <int TILE>
__device__ __forceinline__ std::uint32_t subtile_mask(const PackedRow& row, const TilePlace& place) {
  const float left = static_cast<float>(place.left) + 0.5f - row.x;
  const float top = static_cast<float>(place.top) + 0.5f - row.y;
  // The slack covers the rounding of this test and of log2_alpha().
  const float terms = fabsf(row.l11) * (fabsf(left) + TILE) + fabsf(row.l21) * (fabsf(top) + TILE);
  const float cut = (row.log2_opacity - kLog2Cut) * 1.00003f + 3e-5f + 2e-6f * terms;
  std::uint32_t mask = 0;
#pragma unroll
  for (int i = 0; i < Tile<TILE>::kWarps; ++i) {
    const float x0 = left + i % Tile<TILE>::kColumns * kSubtileWidth, x1 = x0 + (kSubtileWidth - 1);
    const float y0 = top + i / Tile<TILE>::kColumns * kSubtileHeight, y1 = y0 + (kSubtileHeight - 1);
    const float near_x = clamp_between(0.f, x0, x1), near_y = clamp_between(0.f, y0, y1);
    const float peak_x = clamp_between(row.dx_per_dy * near_y, x0, x1);
    const float peak_y = clamp_between(row.dy_per_dx * near_x, y0, y1);
    const float u1 = row.l11 * peak_x + row.l21 * near_y, v1 = row.l22 * near_y;
    const float u2 = row.l11 * near_x + row.l21 * peak_y, v2 = row.l22 * peak_y;
    const float q = fminf(u1 * u1 + v1 * v1, u2 * u2 + v2 * v2);
    mask |= static_cast<std::uint32_t>(q <= cut) << i;
  }
  return mask;
}

// A batch of list entries in shared memory.
template <int TILE, int BATCH>
struct EntryBatch {
  static constexpr int kWords = BATCH / 32;
  float4 place[BATCH];  // x, y, l11, l21
  float2 rest[BATCH];   // l22, log2_opacity
  float4 color[BATCH];
  std::uint32_t hits[Tile<TILE>::kWarps][kWords];  // entries each subtile has to look at

  // Called by the whole block, threads >= BATCH included; row < 0 where there is no entry.
  __device__ __forceinline__ void load(const PackedRow* rows, const ChannelChunk& chunk, std::int32_t row,
                                       const TilePlace& tile, int thread) {
    if (thread >= BATCH) return;
    const int lane = thread & 31;
    std::uint32_t mask = 0;
    if (row >= 0) {
      const float4* source = reinterpret_cast<const float4*>(rows + row);
      const float4 a = __ldg(source), b = __ldg(source + 1);
      color[thread] = load_color(chunk, row);
      place[thread] = a;
      rest[thread] = make_float2(b.x, b.y);
      mask = subtile_mask<TILE>({a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w}, tile);
    }
    std::uint32_t mine = 0;
#pragma unroll
    for (int i = 0; i < Tile<TILE>::kWarps; ++i) {
      const std::uint32_t word = __ballot_sync(kFullWarp, mask >> i & 1u);
      if (lane == i) mine = word;
    }
    if (lane < Tile<TILE>::kWarps) hits[lane][thread >> 5] = mine;
  }
};

}  // namespace blitzgs::cuda
