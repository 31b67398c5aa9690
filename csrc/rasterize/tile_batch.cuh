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

// A list entry in shared memory.
struct __align__(16) Entry {
  float x, y, l11, l21;
  float l22, log2_opacity, unused[2];
  float4 color;
};

// log2 of the unclipped alpha at a pixel. Written out with the fused operations, because forward and backward
// must agree bit by bit on which pixels a row touches.
__device__ __forceinline__ float log2_alpha(const Entry& entry, const Pixel& pixel) {
  const float4 a = reinterpret_cast<const float4*>(&entry)[0];
  const float2 b = reinterpret_cast<const float2*>(&entry)[2];
  const float dx = pixel.centre_x - a.x, dy = pixel.centre_y - a.y;
  const float u = __fmaf_rn(a.z, dx, __fmul_rn(a.w, dy));
  const float v = __fmul_rn(b.x, dy);
  return __fmaf_rn(-u, u, __fmaf_rn(-v, v, b.y));
}

// A batch of list entries in shared memory, and for each subtile the list of those it has to look at, as byte
// offsets so that the loops over them spend nothing on addresses. The lists are filled up to whole quads with
// an entry that touches nothing.
template <int TILE, int BATCH>
struct EntryBatch {
  static constexpr int kWords = BATCH / 32;
  Entry entries[BATCH + 1];
  std::uint32_t hits[Tile<TILE>::kWarps][kWords];
  std::uint16_t lists[Tile<TILE>::kWarps][BATCH + 4];

  // Once per block, before the first load.
  __device__ __forceinline__ void init(int thread) {
    if (thread == 0) entries[BATCH] = {0.f, 0.f, 0.f, 0.f, 0.f, -INFINITY, {0.f, 0.f}, {0.f, 0.f, 0.f, 0.f}};
  }

  // Called by the whole block, threads >= BATCH included; row < 0 where there is no entry.
  __device__ __forceinline__ void load(const PackedRow* rows, const ChannelChunk& chunk, std::int32_t row,
                                       const TilePlace& tile, int thread) {
    if (thread >= BATCH) return;
    const int lane = thread & 31;
    std::uint32_t mask = 0;
    if (row >= 0) {
      const float4* source = reinterpret_cast<const float4*>(rows + row);
      const float4 a = __ldg(source), b = __ldg(source + 1);
      float4* target = reinterpret_cast<float4*>(entries + thread);
      target[2] = load_color(chunk, row);
      target[0] = a;
      target[1] = b;
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

  // Writes the warp's list, of the batch's first `limit` entries, and returns its length.
  template <bool BACKWARDS>
  __device__ __forceinline__ int list(int warp, int lane, int limit) {
    int n = 0;
#pragma unroll
    for (int i = 0; i < kWords; ++i) {
      const int word = BACKWARDS ? kWords - 1 - i : i;
      if (word * 32 >= limit) continue;
      std::uint32_t bits = hits[warp][word];
      if (limit - word * 32 < 32) bits &= (1u << (limit - word * 32)) - 1u;
      const std::uint32_t before = BACKWARDS ? bits & (0xfffffffeu << lane) : bits & ((1u << lane) - 1u);
      if (bits >> lane & 1u) {
        lists[warp][n + __popc(before)] = static_cast<std::uint16_t>((word * 32 + lane) * sizeof(Entry));
      }
      n += __popc(bits);
    }
    if (lane < 4) lists[warp][n + lane] = static_cast<std::uint16_t>(BATCH * sizeof(Entry));
    __syncwarp();
    return n;
  }

  // Four offsets of a list.
  __device__ __forceinline__ void quad(int warp, int at, std::uint32_t* offsets) const {
    const uint2 packed = *reinterpret_cast<const uint2*>(&lists[warp][at]);
    offsets[0] = packed.x & 0xffffu;
    offsets[1] = packed.x >> 16;
    offsets[2] = packed.y & 0xffffu;
    offsets[3] = packed.y >> 16;
  }

  __device__ __forceinline__ const Entry& at(std::uint32_t offset) const {
    return *reinterpret_cast<const Entry*>(reinterpret_cast<const char*>(entries) + offset);
  }
};

}  // namespace blitzgs::cuda
