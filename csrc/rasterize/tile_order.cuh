// SPDX-License-Identifier: Apache-2.0
// The order in which the blocks of a launch take the tiles; it changes no pixel. Blocks start in the order of
// their numbers. The tiles of the last blocks should have short lists, so that no multiprocessor still works
// on a long list when the others are done. Whole images end with rows of near ground, whose lists are short.
// The tiles of one rank may end with the far rows of a view, so there the tiles with long lists come first.
// Forward makes the order and keeps it for backward, which may differentiate fewer tiles.
#pragma once
#include "common/cuda.cuh"
#include "math/tiles.h"
#include "rasterize/rasterize.h"

namespace blitzgs::cuda {

// The composited tiles by class, the number of bits of the length of their list. The first class has the
// longest lists, the last one the empty lists. Kept are the number of tiles in each class, and the tiles, in
// any order, with memory for n_tiles in each class. Both pointers are null if all tiles are composited; the
// blocks then take the tiles in the order of their numbers.
struct TileOrder {
  int32_t* counts = nullptr;  // [kTileOrderClasses], 16-byte aligned
  int32_t* tiles = nullptr;   // [kTileOrderClasses, n_tiles]
  int64_t first;
  int n_tiles;

  // The number of int32 values that the order of `composited` tiles of the grid needs.
  static int64_t words(const TileGrid& grid, int64_t composited) {
    return composited == grid.count() ? 0 : (1 + composited) * kTileOrderClasses;
  }

  // memory: [words()]. All tiles of the grid's range must be among the composited tiles.
  TileOrder(const TileGrid& grid, int64_t composited, int32_t* memory)
      : first(grid.tile_begin), n_tiles(int(grid.tile_end - grid.tile_begin)) {
    if (composited == grid.count()) return;
    counts = memory;
    tiles = counts + kTileOrderClasses;
    n_tiles = int(composited);
  }

  // Sets the counts to zero. Queued before the kernel that calls add().
  void clear(CudaStream stream) const {
    if (counts) zero("tile_order", counts, kTileOrderClasses, stream);
  }

  // Adds tile number `local` of the owned tiles to its class. All lanes of the warp must call this.
  __device__ void add(const int64_t* tile_offsets, int local) const {
    const bool present = local < n_tiles;
    int length_class = -1;
    if (present) {
      const int64_t* offset = tile_offsets + first + local;
      const auto length = uint32_t(offset[1] - offset[0]);
      length_class = max(kTileOrderClasses - 1 - (32 - __clz(length)), 0);
    }
    const unsigned same = __match_any_sync(kFullWarp, length_class);
    const int lane = threadIdx.x % 32, leader = __ffs(same) - 1;
    int before = 0;
    if (lane == leader && present) before = atomicAdd(counts + length_class, __popc(same));
    before = __shfl_sync(kFullWarp, before, leader);
    if (!present) return;
    const int place = before + __popc(same & ((1u << lane) - 1));
    tiles[int64_t(length_class) * n_tiles + place] = int32_t(first + local);
  }

  // The number of tiles that prepare_kernel has to add.
  int unordered() const { return counts ? n_tiles : 0; }

  // The tile that block number `block` < n_tiles takes.
  __device__ __forceinline__ int64_t tile(int block) const {
    if (!counts) return first + block;
    const int32_t* class_tiles = tiles;
    const auto* quads = reinterpret_cast<const int4*>(counts);
#pragma unroll
    for (int i = 0; i < kTileOrderClasses / 4; ++i) {
      const int4 four = quads[i];
      for (const int count : {four.x, four.y, four.z, four.w}) {
        if (block < count) return class_tiles[block];
        block -= count;
        class_tiles += n_tiles;
      }
    }
    return 0;  // not reached: the counts add up to n_tiles
  }
};

}  // namespace blitzgs::cuda
