// SPDX-License-Identifier: Apache-2.0
// In which order a launch takes its tiles. Blocks start in the order of their numbers, and the last to start
// should be short, so that no multiprocessor is left with a long list when the others are done. Images end
// with their near, sparse rows; but a rank's share of the tiles may end with the far rows of a view, so there
// long lists come first. Which tile comes when changes no pixel. The order is made once: forward leaves it
// for backward, which may differentiate fewer tiles than were composited.
#pragma once
#include <cstdint>

#include "common/cuda.cuh"
#include "math/tiles.h"
#include "rasterize/rasterize.h"

namespace blitzgs::cuda {

// By the power of two below their length; the first class has the longest lists, the last the empty ones.
inline constexpr int kLengthClasses = kTileOrderClasses;

// The composited tiles by class: how many each class has, and which, in any order, n_tiles places for each.
// Null where all tiles are composited, which come one after the other.
struct TileOrder {
  std::int32_t* counts = nullptr;  // [kLengthClasses], 16-byte aligned
  std::int32_t* tiles = nullptr;   // [kLengthClasses, n_tiles]
  std::int64_t first;
  int n_tiles;

  // Numbers of the order of so many of the tiles of a grid's images.
  static std::int64_t words(const TileGrid& grid, std::int64_t composited) {
    return composited == grid.count() ? 0 : (1 + composited) * kLengthClasses;
  }

  // In such memory, for tiles that are all among the composited ones.
  TileOrder(const TileGrid& grid, std::int64_t composited, std::int32_t* memory)
      : first(grid.tile_begin), n_tiles(static_cast<int>(grid.tile_end - grid.tile_begin)) {
    if (composited == grid.count()) return;
    counts = memory;
    tiles = counts + kLengthClasses;
    n_tiles = static_cast<int>(composited);
  }

  // Before any tile is noted.
  void clear(CudaStream stream) const {
    if (counts) zero("tile_order", counts, kLengthClasses, stream);
  }

  // Notes tile number `local` of the owned ones; the whole warp takes part. Counts are zero at first.
  __device__ void add(const std::int64_t* tile_offsets, int local) const {
    const bool present = local < n_tiles;
    int length_class = -1;
    if (present) {
      const std::int64_t* offset = tile_offsets + first + local;
      const auto length = static_cast<std::uint32_t>(offset[1] - offset[0]);
      length_class = max(kLengthClasses - 1 - (32 - __clz(length)), 0);
    }
    const unsigned same = __match_any_sync(kFullWarp, length_class);
    const int lane = threadIdx.x % 32, leader = __ffs(same) - 1;
    int before = 0;
    if (lane == leader && present) before = atomicAdd(counts + length_class, __popc(same));
    before = __shfl_sync(kFullWarp, before, leader);
    if (!present) return;
    const int place = before + __popc(same & ((1u << lane) - 1));
    tiles[static_cast<std::int64_t>(length_class) * n_tiles + place] =
        static_cast<std::int32_t>(first + local);
  }

  // Tiles that are to be added.
  int unordered() const { return counts ? n_tiles : 0; }

  // The tile that a block takes, block < n_tiles.
  __device__ __forceinline__ std::int64_t tile(int block) const {
    if (!counts) return first + block;
    const std::int32_t* of_class = tiles;
    const auto* quads = reinterpret_cast<const int4*>(counts);
#pragma unroll
    for (int i = 0; i < kLengthClasses / 4; ++i) {
      const int4 four = quads[i];
      for (const int count : {four.x, four.y, four.z, four.w}) {
        if (block < count) return of_class[block];
        block -= count;
        of_class += n_tiles;
      }
    }
    return 0;  // not reached: the counts add up to n_tiles
  }
};

}  // namespace blitzgs::cuda
