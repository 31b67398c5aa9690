// SPDX-License-Identifier: Apache-2.0
// Routing: which ranks a projected row has to be sent to.
//
// Rank m composites the tiles [begin[m], end[m]) of all cameras, flattened as in math/tiles.h. The ranges may
// overlap; their begins ascend. Row p goes to rank m iff for_each_tile_row() visits a tile of its range:
// exactly the rows that intersect lists there.
//
//   means2d [P, 2] pixels, conics [P, 3], opacities [P], camera_ids int32 [P]
//   -> masks int64 [P], bit m set for rank m; counts int64 [M, 2]: rows for rank m, and the row-tile
//      intersections they make there.
//
// Integers only, so deterministic on every backend. O(tile rows of the splats) and O(P M). M <= 63.
#pragma once
#include <cstdint>

#include "common/stream.h"
#include "math/rank_tiles.h"
#include "math/tiles.h"

namespace blitzgs {

template <class T>
struct RouteInput {
  const T* means2d;
  const T* conics;
  const T* opacities;
  const std::int32_t* camera_ids;
  std::int64_t n_rows;
  TileGrid grid;
  RankTiles ranks;
};

// Calls f(rank, tiles) for each piece of a tile row inside a rank's range; returns the mask of the ranks.
template <class T, class F>
BLITZGS_HD std::int64_t route_row(const RouteInput<T>& in, std::int64_t row, const F& f) {
  const TileGrid& grid = in.grid;
  const std::int64_t first_tile = in.camera_ids[row] * grid.per_image();
  std::int64_t mask = 0;
  for_each_tile_row(in.means2d + 2 * row, in.conics + 3 * row, in.opacities[row], grid.width, grid.height,
                    grid.tile_size, [&](int ty, int tx_begin, int tx_end) {
                      const std::int64_t start = first_tile + static_cast<std::int64_t>(ty) * grid.tiles_x;
                      for_each_rank(in.ranks, start + tx_begin, start + tx_end,
                                    [&](int m, std::int64_t tiles) {
                                      mask |= std::int64_t{1} << m;
                                      f(m, tiles);
                                    });
                    });
  return mask;
}

namespace cpu {
template <class T>
void route_count(const RouteInput<T>& in, std::int64_t* masks, std::int64_t* counts, Workspace&, CudaStream);
}  // namespace cpu

namespace cuda {
template <class T>
void route_count(const RouteInput<T>& in, std::int64_t* masks, std::int64_t* counts, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
