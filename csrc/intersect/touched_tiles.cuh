// SPDX-License-Identifier: Apache-2.0
// Which tiles a splat touches, found once and kept in 16 bytes. Only files that are compiled without
// contraction may include this (cmake/cuda.cmake), because the projection must count the same tiles.
#pragma once
#include "common/running_sum.cuh"
#include "common/warp.cuh"
#include "intersect/intersect.h"

namespace blitzgs::cuda {

// Tiles are counted from tile_begin on and fit 32 bits (intersect_op.cpp).
struct Owned {
  int first, last;  // tiles [first, last)
  int ty;           // the tile row in its image
};

struct SplatShape {
  float mean[2], conic[3], opacity;
  int camera;
};

__device__ __forceinline__ SplatShape load_splat(const IntersectInput<float>& in, std::int64_t index) {
  const float2 mean = reinterpret_cast<const float2*>(in.means2d)[index];
  const float* const conic = in.conics + 3 * index;
  const SplatShape s{
      {mean.x, mean.y}, {conic[0], conic[1], conic[2]}, in.opacities[index], in.camera_ids[index]};
  // This makes the thread wait for all loads together. Otherwise the compiler moves each load behind the
  // tests before it.
  asm volatile("" ::"f"(s.mean[0]), "f"(s.mean[1]), "f"(s.conic[0]), "f"(s.conic[1]), "f"(s.conic[2]),
               "f"(s.opacity), "r"(s.camera));
  return s;
}

// Calls f(owned tiles) for each tile row the splat touches.
template <class F>
__device__ __forceinline__ void for_each_owned(const TileGrid& grid, const SplatShape& splat, const F& f) {
  const int n_owned = static_cast<int>(grid.tile_end - grid.tile_begin);
  const int image = splat.camera * static_cast<int>(grid.per_image()) - static_cast<int>(grid.tile_begin);
  for_each_tile_row(splat.mean, splat.conic, splat.opacity, grid.width, grid.height, grid.tile_size,
                    [&](int ty, int begin, int end) {
                      const int base = image + ty * grid.tiles_x;
                      const Owned owned{max(base + begin, 0), min(base + end, n_owned), ty};
                      if (owned.first < owned.last) f(owned);
                    });
}

// The owned tiles that a splat touches. The compact form is tile `first` (counted from tile_begin) and up to
// twelve tile rows of a byte each: the low half of the byte is the number of tiles, the high half 8 + the
// shift of the first of them against that of the first tile row. Other shapes have first = kWalk, and their
// number of tiles in rows[0].
struct alignas(16) Touched {
  static constexpr std::uint32_t kWalk = ~0u;
  static constexpr int kWords = 3;
  std::uint32_t first, rows[kWords];

  static constexpr std::uint32_t kCounts = 0x0f0f0f0fu, kOnes = 0x01010101u, kHighBits = 0x80808080u;

  __device__ std::int32_t count() const {
    if (first == kWalk) return static_cast<std::int32_t>(rows[0]);
    const std::uint32_t sums = (rows[0] & kCounts) + (rows[1] & kCounts) + (rows[2] & kCounts);
    return static_cast<std::int32_t>(sums * kOnes >> 24);
  }

  __device__ bool compact() const { return first != kWalk; }

  // Returns tile k < count() of a compact splat, counted from tile_begin.
  __device__ std::uint32_t tile(std::uint32_t k, std::uint32_t tiles_x) const {
    std::uint32_t start = first, word = rows[0];
    // Byte j of `through` is the number of tiles in rows 0 to j of the word.
    std::uint32_t through = (word & kCounts) * kOnes;
#pragma unroll
    for (int i = 1; i < kWords; ++i) {
      if (k < through >> 24) break;
      k -= through >> 24;
      start += 4 * tiles_x;
      word = rows[i];
      through = (word & kCounts) * kOnes;
    }
    // Finds the first byte that counts more than k. Bytes are at most 60, so the subtraction does not borrow
    // between them.
    const std::uint32_t reached = ((through | kHighBits) - (k + 1) * kOnes) & kHighBits;
    const int bit = (__ffs(reached) - 1) & 24;
    return start + (bit >> 3) * tiles_x + (word >> (bit + 4) & 15u) - 8 + k - (through << 8 >> bit & 255u);
  }

  // Returns the value of another lane; called by whole warps.
  __device__ Touched of_lane(int lane) const {
    Touched other{__shfl_sync(kFullWarp, first, lane), {}};
    for (int k = 0; k < kWords; ++k) other.rows[k] = __shfl_sync(kFullWarp, rows[k], lane);
    return other;
  }
};

__device__ __forceinline__ Touched find_touched(const TileGrid& grid, const SplatShape& splat) {
  int count = 0, first = 0, top = 0;
  bool compact = true;
  Touched touched{};
  for_each_owned(grid, splat, [&](const Owned& owned) {
    if (count == 0) {
      first = owned.first;
      top = owned.ty;
    }
    const int n = owned.last - owned.first, down = owned.ty - top;
    const unsigned shift = static_cast<unsigned>(owned.first - first - down * grid.tiles_x + 8);
    compact &= down < 4 * Touched::kWords && n < 16 && shift < 16;
    const std::uint32_t bits = (shift << 4 | n) << 8 * (down & 3);
#pragma unroll
    for (int i = 0; i < Touched::kWords; ++i) touched.rows[i] |= down >> 2 == i ? bits : 0u;
    count += n;
  });
  touched.first = static_cast<std::uint32_t>(first);
  if (!compact) {
    touched.first = Touched::kWalk;
    touched.rows[0] = static_cast<std::uint32_t>(count);
  }
  return touched;
}

}  // namespace blitzgs::cuda
