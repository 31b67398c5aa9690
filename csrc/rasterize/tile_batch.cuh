// SPDX-License-Identifier: Apache-2.0
// Device code that the CUDA rasteriser's forward and backward kernels share: packed splats, the arithmetic of
// alpha (docs/image.md, section 3), and how a block reads a batch of its tile's list.
//
// A block composites a tile of 16x16 pixels, a half-warp a subtile of 4x4, a lane a pixel. The block copies
// the tile's list to shared memory in batches. Each thread tests one entry against all sixteen subtiles,
// conservatively, and from these tests each half-warp makes the list of the entries that may touch its
// subtile: a splat of a few pixels touches about three. A warp's halves visit their lists in lockstep.
#pragma once
#include "math/tiles.h"
#include "rasterize/rasterize.h"
#include "rasterize/tile_order.cuh"

namespace blitzgs::cuda {

inline constexpr float kLog2Cut = -7.99435343685886f;    // log2(1/255)
inline constexpr float kFactorScale = 0.849321800288f;   // sqrt(log2(e) / 2)
inline constexpr float kInverseScale2 = 1.38629436112f;  // 1 / kFactorScale^2
inline constexpr int kSubtile = 4;                       // edge in pixels
inline constexpr int kHalfWarp = 16;

// A splat as the kernels read it: one 32-byte sector, so that a gather reads no unused bytes. With
// conic = L^T L (factor_conic), l11, l21, l22 are scaled by sqrt(log2(e) / 2), so that
// log2(alpha) = log2_opacity - (l11 dx + l21 dy)^2 - (l22 dy)^2.
struct __align__(32) PackedSplat {
  float x, y, l11, l21;
  float l22, log2_opacity;
  float dx_per_dy;  // along a row of pixels at dy, alpha is largest at dx = dx_per_dy * dy
  float turn;       // the ellipse {log2(alpha) >= log2_opacity - r^2} reaches furthest right at dy = turn * r
};

// A SplatGradient as the kernels move it: mean2d x y, conic a b | conic c, opacity, color 0 1 | color 2 3,
// mean2d_abs x y.
struct __align__(16) PackedGradient {
  float4 quads[3];
};
static_assert(sizeof(PackedGradient) == sizeof(SplatGradient));

// The edge of a tile in pixels, and the most channels that one launch composites.
inline constexpr int kTileSize = 16, kChunkChannels = 4;

inline void check_tile_size(const char* op, const TileGrid& grid) {
  if (grid.tile_size == kTileSize) return;
  throw std::runtime_error(std::string("blitzgs::") + op + ": tile_size must be 16 on CUDA, got " +
                           std::to_string(grid.tile_size));
}

inline PackedSplat* packed_splats(const RasterizeAux& aux) { return static_cast<PackedSplat*>(aux.packed); }

// The packed colours, which follow the packed splats in memory; null if there are too many channels to pack.
inline float4* packed_colors(const RasterizeAux& aux, int n_channels) {
  return n_channels <= kChunkChannels ? reinterpret_cast<float4*>(packed_splats(aux) + aux.splats) : nullptr;
}

// The channels that one launch composites: `count` (at most 4) of n_channels, from channel `first` on.
struct ChannelChunk {
  const float4* packed;  // packed_colors(), or null
  const float* colors;   // [P, n_channels], read if `packed` is null
  int n_channels, first, count;
};

// What a launch of either pass reads for one chunk of channels.
struct ChunkInput {
  const PackedSplat* splats;
  ChannelChunk chunk;
  const float* backgrounds;
  const int32_t* isect_splats;
  const int64_t* tile_offsets;
  TileGrid grid;
  TileOrder order;

  ChunkInput(const RasterizeInput<float>& in, const RasterizeAux& aux, int first)
      : splats(packed_splats(aux)),
        chunk{packed_colors(aux, in.n_channels), in.colors, in.n_channels, first,
              std::min(kChunkChannels, in.n_channels - first)},
        backgrounds(in.backgrounds),
        isect_splats(in.isect_splats),
        tile_offsets(in.tile_offsets),
        grid(in.grid),
        order(in.grid, aux.composited, aux.order) {}
};

// Asynchronous copies to shared memory. The thread that starts them waits for them with copies_done().
__device__ __forceinline__ void copy_quad(void* shared, const void* global) {
  const auto address = uint32_t(__cvta_generic_to_shared(shared));
  asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(address), "l"(global) : "memory");
}

__device__ __forceinline__ void copy_float(void* shared, const void* global) {
  const auto address = uint32_t(__cvta_generic_to_shared(shared));
  asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(address), "l"(global) : "memory");
}

__device__ __forceinline__ void copies_done() { asm volatile("cp.async.wait_all;" ::: "memory"); }

__device__ __forceinline__ void copy_color(float* shared, const ChannelChunk& chunk, int32_t splat) {
  if (chunk.packed) {
    copy_quad(shared, chunk.packed + splat);
    return;
  }
  const float* color = chunk.colors + int64_t(splat) * chunk.n_channels + chunk.first;
  for (int k = 0; k < 4; ++k) {
    if (k < chunk.count) {
      copy_float(shared + k, color + k);
    } else {
      shared[k] = 0.f;
    }
  }
}

__device__ __forceinline__ float channel(const float4& c, int k) {
  return k == 0 ? c.x : k == 1 ? c.y : k == 2 ? c.z : c.w;
}

// exp2_approx is exact to 2 units in the last place, reciprocal_approx to 1. A build with BLITZGS_EXACT_EXP
// rounds both correctly; it serves to measure the difference (benchmarks/bm_accuracy.py).
__device__ __forceinline__ float exp2_approx(float x) {
#ifdef BLITZGS_EXACT_EXP
  return float(exp2(double(x)));
#else
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#endif
}

__device__ __forceinline__ float reciprocal_approx(float x) {
#ifdef BLITZGS_EXACT_EXP
  return __frcp_rn(x);
#else
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#endif
}

__device__ __forceinline__ float sqrt_approx(float x) {
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

struct Tile {
  static constexpr int kThreads = kTileSize * kTileSize;
  static constexpr int kWarps = kThreads / 32;
  static constexpr int kColumns = kTileSize / kSubtile;
  static constexpr int kSubtiles = kColumns * kColumns;
  static_assert(kSubtiles <= 32);  // the bits of a word
};

struct Pixel {
  int x, y;       // in the image
  int subtile;    // the index of its subtile in the tile
  bool inside;    // whether the pixel is inside the image
  int64_t index;  // (camera, y, x) flattened
  float dx, dy;   // from the tile's centre to the pixel's centre: multiples of 1/2, so exact
};

struct TilePlace {
  int64_t tile;
  int camera, left, top;
};

__device__ __forceinline__ TilePlace locate_tile(const TileGrid& grid, int64_t tile) {
  TilePlace place;
  place.tile = tile;
  // There is a block for each tile, so tile numbers fit 32 bits, in which division is faster.
  const auto number = uint32_t(tile), columns = uint32_t(grid.tiles_x);
  const auto per_image = uint32_t(grid.per_image());
  const uint32_t in_image = number % per_image;
  place.camera = int(number / per_image);
  place.top = int(in_image / columns * kTileSize);
  place.left = int(in_image % columns * kTileSize);
  return place;
}

// Thread t composites pixel t % 16 of subtile t / 16. A warp has two subtiles side by side.
__device__ __forceinline__ Pixel locate_pixel(const TileGrid& grid, const TilePlace& place, int thread) {
  constexpr int kColumns = Tile::kColumns;
  const int lane = thread % kHalfWarp;
  Pixel pixel;
  pixel.subtile = thread / kHalfWarp;
  const int x = pixel.subtile % kColumns * kSubtile + lane % kSubtile;
  const int y = pixel.subtile / kColumns * kSubtile + lane / kSubtile;
  pixel.x = place.left + x;
  pixel.y = place.top + y;
  pixel.inside = pixel.x < grid.width && pixel.y < grid.height;
  pixel.index = (int64_t(place.camera) * grid.height + pixel.y) * grid.width + pixel.x;
  pixel.dx = float(x) + (0.5f - kTileSize / 2);
  pixel.dy = float(y) + (0.5f - kTileSize / 2);
  return pixel;
}

__device__ __forceinline__ float clamp_between(float value, float low, float high) {
  return fminf(fmaxf(value, low), high);
}

// The lowest bits of the result are those of the least integer >= scale * value + shift, for results below
// 2^22 in magnitude: adding 1.5 * 2^23 shifts the fraction out of the significand.
__device__ __forceinline__ uint32_t ceil_bits(float scale, float value, float shift) {
  return __float_as_uint(__fmaf_ru(scale, value, shift + 12582912.f));
}

// Returns one bit per subtile, row by row: whether alpha may reach 1/255 at one of the subtile's pixel
// centres. The points with alpha >= 1/255 form an ellipse. Its part in a row of subtiles spans an interval of
// x whose ends have a closed form (as in math/tiles.h).
__device__ __forceinline__ uint32_t subtile_mask(const PackedSplat& splat, const TilePlace& place) {
  constexpr int kColumns = Tile::kColumns;
  constexpr uint32_t kRow = (1u << kColumns) - 1u;
  // From the centre of the tile's first pixel to the mean.
  const float x = splat.x - (float(place.left) + 0.5f);
  const float y = splat.y - (float(place.top) + 0.5f);
  // The slack covers the rounding of this test and of log2_alpha().
  const float terms = fabsf(splat.l11) * (fabsf(x) + kTileSize) + fabsf(splat.l21) * (fabsf(y) + kTileSize);
  const float cut = (splat.log2_opacity - kLog2Cut) * 1.00003f + 3e-5f + 2e-6f * terms;
  const float slack = 2e-6f * (fabsf(x) + fabsf(splat.dx_per_dy) * (fabsf(y) + kTileSize)) + 1e-5f;
  const float inverse = 1.000003f * reciprocal_approx(splat.l11);
  const float turn = splat.turn * sqrt_approx(cut);
  const float left = x - slack - (kSubtile - 1), right = x + slack;
  uint32_t mask = 0;
#pragma unroll
  for (int i = 0; i < kColumns; ++i) {
    const float y0 = float(i * kSubtile) - y, y1 = y0 + (kSubtile - 1);
    const float dy_left = clamp_between(-turn, y0, y1), dy_right = clamp_between(turn, y0, y1);
    const float v_left = splat.l22 * dy_left, v_right = splat.l22 * dy_right;
    const float rest_left = cut - v_left * v_left, rest_right = cut - v_right * v_right;
    const float reach_left = sqrt_approx(fmaxf(rest_left, 0.f)) * inverse;
    const float reach_right = sqrt_approx(fmaxf(rest_right, 0.f)) * inverse;
    const float end_left = splat.dx_per_dy * dy_left - reach_left + left;
    const float end_right = splat.dx_per_dy * dy_right + reach_right + right;
    // Subtile c has the pixels 4 c to 4 c + 3. fminf and fmaxf replace a NaN bound by the edge of the tile.
    const uint32_t skip_left =
        ceil_bits(0.25f, fminf(fmaxf(end_left, 1.f - kSubtile), float(kTileSize)), 0.f);
    const uint32_t skip_right =
        ceil_bits(-0.25f, fmaxf(fminf(end_right, float(kTileSize - 1)), -4.f), kColumns - 1.f);
    const uint32_t bits = __funnelshift_l(0u, kRow, skip_left) & __funnelshift_r(kRow, 0u, skip_right);
    if (rest_right >= 0.f) mask |= bits << i * kColumns;
  }
  return mask;
}

// A list entry in shared memory. The first six numbers are the splat relative to the tile's centre, for
// log2_alpha().
struct __align__(16) Entry {
  float l11, l21, u, l22;
  float v, log2_opacity, x, y;  // x, y: the mean
  float color[4];
};

// log2 of the unclipped alpha at a pixel. The fused operations are explicit, because forward and backward
// must agree bit by bit on the pixels that a splat touches.
__device__ __forceinline__ float log2_alpha(const Entry& entry, const Pixel& pixel) {
  const float4 a = reinterpret_cast<const float4*>(&entry)[0];
  const float2 b = reinterpret_cast<const float2*>(&entry)[2];
  const float u = __fmaf_rn(a.x, pixel.dx, __fmaf_rn(a.y, pixel.dy, a.z));
  const float v = __fmaf_rn(a.w, pixel.dy, b.x);
  return __fmaf_rn(-u, u, __fmaf_rn(-v, v, b.y));
}

// Two batches of list entries in shared memory, so that one is copied while the other is composited, and for
// each subtile the list of the batch's entries that may touch it. The lists hold byte offsets of entries, so
// that the loops over them need no address arithmetic. Each list is padded with an entry that touches no
// pixel to a multiple of four, and to the length of the list of the warp's other half.
//
// Thread i < BATCH copies and tests entry i of each batch. The order of calls is fetch(first batch), and then
// for each batch place(this batch), barrier, fetch(next batch), list(this batch). One barrier per batch is
// enough: the data that fetch() overwrites was last read before this barrier, and the data that place()
// overwrites was last read before the previous one.
template <int BATCH> struct EntryBatch {
  static constexpr int kWords = BATCH / 32;
  static constexpr int kLaneBits =
      BATCH / kHalfWarp;  // entries of the batch that each lane of list() handles
  static constexpr uint32_t kNothing = BATCH * sizeof(Entry);
  Entry entries[2][BATCH + 1];
  uint32_t hits[2][Tile::kSubtiles][kWords];
  uint16_t lists[Tile::kSubtiles][BATCH + 4];

  // Writes the entries that touch no pixel. Called once per block, before the first barrier.
  __device__ __forceinline__ void init(int thread) {
    if (thread < 2) {
      entries[thread][BATCH] = {0.f, 0.f, 0.f, 0.f, 0.f, -INFINITY, 0.f, 0.f, {0.f, 0.f, 0.f, 0.f}};
    }
  }

  // Starts to copy entry `at` to buffer `buffer`, which no thread may read at that time. splat < 0: the list
  // has no such entry. `chunk` is an argument of copy_color().
  template <class Chunk>
  __device__ __forceinline__ void fetch(int buffer, const PackedSplat* splats, const Chunk& chunk,
                                        int32_t splat, int at) {
    if (splat < 0) return;
    auto* target = reinterpret_cast<float4*>(&entries[buffer][at]);
    const auto* source = reinterpret_cast<const float4*>(splats + splat);
    copy_quad(target, source);
    copy_quad(target + 1, source + 1);
    copy_color(entries[buffer][at].color, chunk, splat);
  }

  // Waits for the copy of entry `at`, converts it to an Entry and tests it against the subtiles. All lanes of
  // a warp must call this.
  __device__ __forceinline__ void place(int buffer, bool present, const TilePlace& tile, int at) {
    const int lane = at & 31;
    copies_done();
    uint32_t mask = 0;
    if (present) {
      auto* target = reinterpret_cast<float4*>(&entries[buffer][at]);
      const float4 a = target[0], b = target[1];
      const float x = a.x - float(tile.left + kTileSize / 2);
      const float y = a.y - float(tile.top + kTileSize / 2);
      target[0] = {a.z, a.w, -__fmaf_rn(a.z, x, __fmul_rn(a.w, y)), b.x};
      target[1] = {-__fmul_rn(b.x, y), b.y, a.x, a.y};
      mask = subtile_mask({a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w}, tile);
    }
    mask = transpose_bits(mask, lane);
    if (lane < Tile::kSubtiles) hits[buffer][lane][at >> 5] = mask;
  }

  // Writes the subtile's list from the batch's first `limit` entries, in reverse order if BACKWARDS. Returns
  // the number of quads of the longer of the warp's two lists. SHARED: both halves of the warp list the
  // entries that may touch either subtile; both must give the same limit.
  template <bool BACKWARDS, bool SHARED>
  __device__ __forceinline__ int list(int buffer, int subtile, int lane, int limit) {
    const int piece = BACKWARDS ? kHalfWarp - 1 - lane : lane;
    const int first = piece * kLaneBits;
    uint32_t word = hits[buffer][subtile][first / 32];
    if constexpr (SHARED) word |= hits[buffer][subtile ^ 1][first / 32];
    const int wanted = min(max(limit - first, 0), kLaneBits);
    uint32_t bits = word >> first % 32 & uint32_t((uint64_t{1} << wanted) - 1);
    const int count = __popc(bits);
    int end = count;
#pragma unroll
    for (int step = 1; step < kHalfWarp; step *= 2) {
      const int before = __shfl_up_sync(kFullWarp, end, step, kHalfWarp);
      if (lane >= step) end += before;
    }
    const int n = __shfl_sync(kFullWarp, end, kHalfWarp - 1, kHalfWarp);
    uint16_t* target = lists[subtile] + (BACKWARDS ? end - count : end - 1);
    while (bits) {  // from the last entry of this lane's piece to the first
      const int bit = 31 - __clz(bits);
      bits ^= 1u << bit;
      *target = uint16_t((first + bit) * int(sizeof(Entry)));
      target += BACKWARDS ? 1 : -1;
    }
    const int quads = (max(n, __shfl_xor_sync(kFullWarp, n, kHalfWarp)) + 3) / 4;
    for (int i = n + lane; i < 4 * quads; i += kHalfWarp) lists[subtile][i] = kNothing;
    __syncwarp();
    return quads;
  }

  // The subtile's list as quads of offsets, for QuadOffsets.
  __device__ __forceinline__ const uint2* quads(int subtile) const {
    return reinterpret_cast<const uint2*>(lists[subtile]);
  }
};

__device__ __forceinline__ const Entry& entry_at(const char* entries, uint32_t offset) {
  return *reinterpret_cast<const Entry*>(entries + offset);
}

struct QuadOffsets {
  uint32_t at[4];
  __device__ __forceinline__ explicit QuadOffsets(uint2 packed)
      : at{packed.x & 0xffffu, packed.x >> 16, packed.y & 0xffffu, packed.y >> 16} {}
};

}  // namespace blitzgs::cuda
