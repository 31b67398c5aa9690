// SPDX-License-Identifier: Apache-2.0
// Which tiles a row touches, found once and kept in 16 bytes. Include it only where contraction is off
// (cmake/cuda.cmake): the projection counts the same tiles.
#pragma once
#include "intersect/intersect.h"
#include "intersect/running_sum.cuh"

namespace blitzgs::cuda {

struct Owned {
  std::int64_t first, last;  // tiles [first, last)
  int ty;                    // the tile row in its image
};

// Calls f(owned tiles) for each tile row the splat touches.
template <class F>
__device__ __forceinline__ void for_each_owned(const IntersectInput<float>& in, std::int64_t row,
                                               const F& f) {
  const TileGrid& grid = in.grid;
  const std::int64_t image = in.camera_ids[row] * grid.per_image();
  const float2 mean2d = reinterpret_cast<const float2*>(in.means2d)[row];
  const float conic[3] = {in.conics[3 * row], in.conics[3 * row + 1], in.conics[3 * row + 2]};
  const float center[2] = {mean2d.x, mean2d.y};
  for_each_tile_row(center, conic, in.opacities[row], grid.width, grid.height, grid.tile_size,
                    [&](int ty, int begin, int end) {
                      const std::int64_t base = image + static_cast<std::int64_t>(ty) * grid.tiles_x;
                      Owned owned{base + begin, base + end, ty};
                      if (owned.first < grid.tile_begin) owned.first = grid.tile_begin;
                      if (owned.last > grid.tile_end) owned.last = grid.tile_end;
                      if (owned.first < owned.last) f(owned);
                    });
}

// The owned tiles that a row touches. Compact: tile `first` (from tile_begin on) and up to twelve tile rows,
// a byte each: in the low half the number of tiles, in the high half 8 + their shift against the first row's.
// Other shapes have first = kWalk, and the number of tiles in rows[0].
struct alignas(16) Touched {
  static constexpr std::uint32_t kWalk = ~0u;
  static constexpr int kWords = 3;
  std::uint32_t first, rows[kWords];

  __device__ std::int32_t count() const {
    if (first == kWalk) return static_cast<std::int32_t>(rows[0]);
    constexpr std::uint32_t kCounts = 0x0f0f0f0fu;
    const std::uint32_t sums = (rows[0] & kCounts) + (rows[1] & kCounts) + (rows[2] & kCounts);
    return static_cast<std::int32_t>(sums * 0x01010101u >> 24);
  }

  __device__ bool compact() const { return first != kWalk; }

  // Tile k < count() of a compact row, from tile_begin on.
  __device__ std::int64_t tile(int k, int tiles_x) const {
    std::int64_t start = static_cast<std::int64_t>(first) - 8;
#pragma unroll
    for (int i = 0; i < kWords; ++i) {
#pragma unroll
      for (int bit = 0; bit < 32; bit += 8, start += tiles_x) {
        const int n = rows[i] >> bit & 15u;
        if (k < n) return start + (rows[i] >> bit + 4 & 15u) + k;
        k -= n;
      }
    }
    return start;
  }

  // That of another lane; called by whole warps.
  __device__ Touched of_lane(int lane) const {
    Touched other{__shfl_sync(kFullWarp, first, lane), {}};
    for (int k = 0; k < kWords; ++k) other.rows[k] = __shfl_sync(kFullWarp, rows[k], lane);
    return other;
  }
};

__device__ __forceinline__ Touched find_touched(const IntersectInput<float>& in, std::int64_t row) {
  std::int64_t count = 0, first = in.grid.tile_begin;
  int top = 0;
  bool compact = true;
  Touched touched{};
  for_each_owned(in, row, [&](const Owned& owned) {
    if (count == 0) {
      first = owned.first;
      top = owned.ty;
    }
    const std::int64_t n = owned.last - owned.first;
    const int down = owned.ty - top;
    const std::int64_t shift = owned.first - first - static_cast<std::int64_t>(down) * in.grid.tiles_x + 8;
    compact &= down < 4 * Touched::kWords && n < 16 && shift >= 0 && shift < 16;
    const std::uint32_t bits = static_cast<std::uint32_t>(shift << 4 | n) << 8 * (down & 3);
#pragma unroll
    for (int i = 0; i < Touched::kWords; ++i) touched.rows[i] |= down >> 2 == i ? bits : 0u;
    count += n;
  });
  first -= in.grid.tile_begin;
  touched.first = static_cast<std::uint32_t>(first);
  if (!compact || first >= Touched::kWalk) {
    touched.first = Touched::kWalk;
    touched.rows[0] = static_cast<std::uint32_t>(count);
  }
  return touched;
}

}  // namespace blitzgs::cuda
