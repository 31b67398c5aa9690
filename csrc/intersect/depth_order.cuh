// SPDX-License-Identifier: Apache-2.0
// The order of compositing (docs/image.md, section 5): sorts splats by (depth, id), by a radix sort of keys
// of up to 27 bits in three passes. A key is the number of floats between the smallest depth of the call and
// the depth. If this needs fewer than 27 bits, the high bits hold the view: splats of different views need no
// order among each other, and fewer keys are then equal. If it needs more (more than a factor of 65536
// between the nearest and the farthest depth), the key lacks the low bits, and splats with equal keys are
// compared by depth and then by id.
#pragma once
#include "intersect/intersect.h"
#include "intersect/radix_sweep.cuh"

// This file also finds the tiles that each splat touches, once per call, and keeps them in 16 bytes. Only
// files that are compiled without FMA contraction may include it (cmake/cuda.cmake), because the projection
// must count the same tiles.

namespace blitzgs::cuda {

// The owned tiles of one tile row that a splat touches. Tile numbers count from tile_begin, in 32 bits.
struct Owned {
  int first, last;  // tiles [first, last)
  int ty;           // the tile row in its image
};

struct SplatShape {
  float mean[2], conic[3], opacity;
  int camera;
};

__device__ __forceinline__ SplatShape load_splat(const IntersectInput<float>& in, int64_t index) {
  const float2 mean = reinterpret_cast<const float2*>(in.means2d)[index];
  const float* const conic = in.conics + 3 * index;
  const SplatShape s{
      {mean.x, mean.y}, {conic[0], conic[1], conic[2]}, in.opacities[index], in.camera_ids[index]};
  // This makes the thread wait for all loads together. Otherwise the compiler would move loads to after the
  // tests of values that are loaded first.
  asm volatile("" ::"f"(s.mean[0]), "f"(s.mean[1]), "f"(s.conic[0]), "f"(s.conic[1]), "f"(s.conic[2]),
               "f"(s.opacity), "r"(s.camera));
  return s;
}

// The owned tiles [begin, end) of tile row ty of a camera's image. Nothing is owned if first >= last.
__device__ __forceinline__ Owned clip_to_owned(const TileGrid& grid, int camera, int ty, int begin, int end) {
  const int image = camera * int(grid.per_image()) - int(grid.tile_begin);
  const int base = image + ty * grid.tiles_x;
  return {max(base + begin, 0), min(base + end, int(grid.tile_end - grid.tile_begin)), ty};
}

// The owned tiles that a splat touches: the first tile (counted from tile_begin) and a byte for each of up to
// twelve tile rows. The low half of a byte is the number of tiles in the row. The high half is 8 plus the
// column of the row's first tile minus the column of the first tile of all. A splat that does not fit this
// form is called large. It has first = kLarge; rows[0] is its number of tiles, rows[1] and rows[2] are the
// position of its first list entry once that is known.
struct alignas(16) Touched {
  static constexpr uint32_t kLarge = ~0u;
  static constexpr int kWords = 3;
  uint32_t first, rows[kWords];

  static constexpr uint32_t kCounts = 0x0f0f0f0fu, kOnes = 0x01010101u, kHighBits = 0x80808080u;

  __device__ bool large() const { return first == kLarge; }

  // The position of a large splat's first list entry.
  __device__ int64_t begin() const { return int64_t(rows[2]) << 32 | rows[1]; }
  __device__ void set_begin(int64_t position) {
    rows[1] = uint32_t(position);
    rows[2] = uint32_t(position >> 32);
  }

  __device__ int32_t count() const {
    if (large()) return int32_t(rows[0]);
    const uint32_t sums = (rows[0] & kCounts) + (rows[1] & kCounts) + (rows[2] & kCounts);
    return int32_t(sums * kOnes >> 24);
  }

  // Returns tile k < count() of a splat that is not large, counted from tile_begin.
  __device__ uint32_t tile(uint32_t k, uint32_t tiles_x) const {
    uint32_t start = first, word = rows[0];
    // Byte j of `through` is the number of tiles in rows 0 to j of the word.
    uint32_t through = (word & kCounts) * kOnes;
#pragma unroll
    for (int i = 1; i < kWords; ++i) {
      if (k < through >> 24) break;
      k -= through >> 24;
      start += 4 * tiles_x;
      word = rows[i];
      through = (word & kCounts) * kOnes;
    }
    // Finds the first byte of `through` that is larger than k. Bytes are at most 60, so none borrows.
    const uint32_t reached = ((through | kHighBits) - (k + 1) * kOnes) & kHighBits;
    const int bit = (__ffs(reached) - 1) & 24;
    return start + (bit >> 3) * tiles_x + (word >> (bit + 4) & 15u) - 8 + k - (through << 8 >> bit & 255u);
  }

  // Returns the value of another lane. All lanes of the warp must call this.
  __device__ Touched from_lane(int lane) const {
    Touched other{__shfl_sync(kFullWarp, first, lane), {}};
    for (int k = 0; k < kWords; ++k) other.rows[k] = __shfl_sync(kFullWarp, rows[k], lane);
    return other;
  }
};

__device__ __forceinline__ Touched find_touched(const TileGrid& grid, const SplatShape& splat) {
  int count = 0, first = 0, top = 0;
  bool fits = true;
  Touched touched{};
  const auto add = [&](int ty, int begin, int end) {
    const Owned owned = clip_to_owned(grid, splat.camera, ty, begin, end);
    if (owned.first >= owned.last) return;
    if (count == 0) {
      first = owned.first;
      top = owned.ty;
    }
    const int n = owned.last - owned.first, down = owned.ty - top;
    const unsigned shift = unsigned(owned.first - first - down * grid.tiles_x + 8);
    fits &= down < 4 * Touched::kWords && n < 16 && shift < 16;
    const uint32_t bits = (shift << 4 | n) << 8 * (down & 3);
#pragma unroll
    for (int i = 0; i < Touched::kWords; ++i) touched.rows[i] |= down >> 2 == i ? bits : 0u;
    count += n;
  };
  for_each_tile_row(splat.mean, splat.conic, splat.opacity, grid.width, grid.height, grid.tile_size, add);
  touched.first = uint32_t(first);
  if (!fits) {
    touched.first = Touched::kLarge;
    touched.rows[0] = uint32_t(count);
  }
  return touched;
}

inline constexpr int kDepthThreads = 256, kDepthBlocks = 5;  // kDepthBlocks: blocks per multiprocessor
inline constexpr int kDepthPasses = 3, kDepthBits = 9, kDepthBins = 1 << kDepthBits;
inline constexpr int kRangeBlocks = kDepthThreads, kRangeThreads = 512;
inline constexpr int kTieItems = 4, kTieSplats = kDepthThreads * kTieItems;
inline constexpr int kShortRun = 16;  // the longest run of equal keys that one thread orders

struct DepthRange {
  uint32_t low, high;

  // Returns the union of the ranges of all threads of a block to each thread. All threads call this.
  template <int kThreads> __device__ DepthRange over_block() const {
    __shared__ DepthRange warps[kThreads / 32];
    const int lane = threadIdx.x % 32;
    DepthRange range{__reduce_min_sync(kFullWarp, low), __reduce_max_sync(kFullWarp, high)};
    if (lane == 0) warps[threadIdx.x / 32] = range;
    __syncthreads();
    range = warps[lane % (kThreads / 32)];
    return {__reduce_min_sync(kFullWarp, range.low), __reduce_max_sync(kFullWarp, range.high)};
  }
};

// The layout of a sort key: the view in the high bits, the depth in the low bits.
struct DepthDigits {
  int dropped;     // the low bits of the depth that the key lacks
  int view_shift;  // the bits of the depth in the key, below the view
  int width;       // the bits of a digit of the radix sort
  uint32_t view_mask;

  __device__ DepthDigits(const DepthRange& range, int n_views) {
    constexpr int kMax = kDepthPasses * kDepthBits;
    const int depth_bits = 32 - __clz(range.high - range.low);
    view_shift = min(depth_bits, kMax);
    dropped = depth_bits - view_shift;
    const int view_bits = min(kMax - view_shift, 32 - __clz(n_views - 1));
    view_mask = (1u << view_bits) - 1;
    width = max(1, (view_shift + view_bits + kDepthPasses - 1) / kDepthPasses);
  }

  // offset: ordered_bits() of the depth minus that of the smallest depth.
  __device__ uint32_t key(uint32_t offset, int32_t view) const {
    return (view & view_mask) << view_shift | offset >> dropped;
  }
};

// The first launch of intersect(). Finds the range of the depths that each block reads (ranges
// [kRangeBlocks]), one thread per splat in a grid-stride loop, and clears the counters of later kernels.
__global__ void __launch_bounds__(kRangeThreads)
    range_kernel(const IntersectInput<float> in, DepthRange* ranges, uint4* zeros, int64_t n_zeros) {
  wait_for_earlier_kernels();
  const int64_t n = valid_splat_count(in);
  constexpr int64_t kStep = kRangeBlocks * kRangeThreads;
  const int64_t thread = blockIdx.x * int64_t(kRangeThreads) + threadIdx.x;
  DepthRange range{0xffffffffu, 0u};
#pragma unroll 8
  for (int64_t i = thread; i < n; i += kStep) {
    const uint32_t bits = ordered_bits(in.depths[i]);
    range = {min(range.low, bits), max(range.high, bits)};
  }
  for (int64_t i = thread; i < n_zeros; i += kStep) zeros[i] = uint4{};
  range = range.over_block<kRangeThreads>();
  if (threadIdx.x == 0) ranges[blockIdx.x] = range;
}

// The second launch. Writes for each splat its sort key (keys [P]) and its tiles (touched [P]), and the
// histograms of the keys' digits [kDepthPasses, kDepthBins]. One thread per splat in a grid-stride loop, with
// as many blocks as run at a time.
__global__ void __launch_bounds__(kDepthThreads, kDepthBlocks)
    depth_keys_kernel(const IntersectInput<float> in, const DepthRange* ranges, uint32_t* keys,
                      Touched* touched, uint64_t* histograms, int* dropped_bits, int* width,
                      int64_t* n_splats) {
  __shared__ uint32_t counts[kDepthPasses][kDepthBins];
  for (int bin = threadIdx.x; bin < kDepthPasses * kDepthBins; bin += kDepthThreads) counts[0][bin] = 0;
  wait_for_earlier_kernels();
  // The number is below 2^31, and a 64-bit loop counter would need more registers than there are.
  const auto n = uint32_t(valid_splat_count(in));
  const DepthRange range =
      ranges[threadIdx.x].over_block<kDepthThreads>();  // also a barrier for the zeroed counters
  const DepthDigits digits(range, in.grid.n_cameras);
  if (blockIdx.x == 0 && threadIdx.x == 0) {
    *dropped_bits = digits.dropped;
    *width = digits.width;
    *n_splats = n;
  }
#pragma unroll 1
  for (uint32_t i = blockIdx.x * kDepthThreads + threadIdx.x; i < n; i += gridDim.x * kDepthThreads) {
    const float depth = in.depths[i];
    const SplatShape splat = load_splat(in, i);
    const uint32_t key = digits.key(ordered_bits(depth) - range.low, splat.camera);
    keys[i] = key;
#pragma unroll
    for (int pass = 0; pass < kDepthPasses; ++pass) {
      atomicAdd(&counts[pass][key >> pass * digits.width & ((1u << digits.width) - 1)], 1u);
    }
    touched[i] = find_touched(in.grid, splat);
  }
  __syncthreads();
  add_counts(counts[0], kDepthPasses * kDepthBins, histograms);
}

struct SplatOrder {
  const float* depths;  // null: not compared
  const int64_t* ids;   // null: the splat index

  __device__ bool before(int32_t a, int32_t b) const {
    if (depths) {
      const uint32_t depth_a = ordered_bits(depths[a]), depth_b = ordered_bits(depths[b]);
      if (depth_a != depth_b) return depth_a < depth_b;
    }
    return ids ? ids[a] < ids[b] : a < b;
  }

  // A bitonic sort by all threads of a block. Every comparison puts the smaller splat first, so the number of
  // splats need not be a power of two.
  __device__ void sort(int32_t* splats, int64_t n) const {
    for (int64_t size = 2; size < 2 * n; size *= 2) {
      for (int64_t step = size / 2; step > 0; step /= 2) {
        __syncthreads();
        for (int64_t i = threadIdx.x; i < (n + 2 * step - 1) / (2 * step) * step; i += blockDim.x) {
          const int64_t at = i & (step - 1), group = 2 * (i - at), low = group + at;
          // The first step of a size mirrors its upper half.
          const int64_t high = 2 * step == size ? group + size - 1 - at : low + step;
          if (high < n && before(splats[high], splats[low])) {
            const int32_t splat = splats[low];
            splats[low] = splats[high];
            splats[high] = splat;
          }
        }
      }
    }
    __syncthreads();
  }
};

// After the radix sort, orders each run of splats with equal keys by (depth, id). One thread for each sorted
// splat; the thread of a run's first splat orders the run if it is short, which is the usual case. The
// threads of a block order longer runs together, one run after the other.
__global__ void __launch_bounds__(kDepthThreads)
    order_ties_kernel(const uint32_t* keys, int32_t* splats, const int64_t* n_splats, SplatOrder order,
                      const int* dropped_bits) {
  __shared__ int64_t long_runs[kTieSplats / kShortRun + 1];
  __shared__ int n_long;
  wait_for_earlier_kernels();
  const int64_t n = *n_splats;
  if (*dropped_bits == 0) {
    if (!order.ids) return;  // the stable sort kept splats of equal depth in order
    order.depths = nullptr;
  }
  if (threadIdx.x == 0) n_long = 0;
  __syncthreads();
  const int64_t first = blockIdx.x * int64_t(kTieSplats) + threadIdx.x;
  unsigned begins = 0;
#pragma unroll
  for (int k = 0; k < kTieItems; ++k) {
    const int64_t i = first + k * kDepthThreads;
    if (i + 1 < n && keys[i] == keys[i + 1] && (i == 0 || keys[i - 1] != keys[i])) begins |= 1u << k;
  }
  for (; begins; begins &= begins - 1) {
    const int64_t i = first + (__ffs(begins) - 1) * kDepthThreads;
    int32_t* const run = splats + i;
    int length = 2;
    while (length <= kShortRun && i + length < n && keys[i + length] == keys[i]) ++length;
    if (length > kShortRun) {
      long_runs[atomicAdd(&n_long, 1)] = i;
      continue;
    }
    for (int at = 1; at < length; ++at) {
      const int32_t splat = run[at];
      int to = at;
      for (; to > 0 && order.before(splat, run[to - 1]); --to) run[to] = run[to - 1];
      if (to < at) run[to] = splat;
    }
  }
  __syncthreads();
  for (int k = 0; k < n_long; ++k) {
    const int64_t begin = long_runs[k];
    int64_t length = 0;
    for (int same = kDepthThreads; same == kDepthThreads; length += same) {
      const int64_t i = begin + length + threadIdx.x;
      same = __syncthreads_count(i < n && keys[i] == keys[begin]);
    }
    order.sort(splats + begin, length);
  }
}

}  // namespace blitzgs::cuda
