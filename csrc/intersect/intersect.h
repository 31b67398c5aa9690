// SPDX-License-Identifier: Apache-2.0
// Intersection: makes the list of each tile, the splats that the tile composites, front to back.
//
// Splat p (a splat in camera camera_ids[p]) is listed in tile t of that camera iff for_each_tile_row() of
// math/tiles.h visits it. Within a tile the splats are ordered by (depth, id); without ids by (depth, splat).
// -0 and 0 are different depths; lists are undefined if a depth is NaN.
//
//   means2d [P, 2] pixels, conics [P, 3], opacities [P], depths [P], camera_ids int32 [P], ids int64 [P] or
//   null  ->  isect_splats int32 [I] splat indices, tile_offsets int64 [B*T + 1] with T = tiles_y * tiles_x:
//   tile t's list is isect_splats[tile_offsets[t] .. tile_offsets[t + 1]). Tiles that grid does not own have
//   empty lists.
//
// known_splats: null, or the number of splats in device memory (common/kernel.h; CUDA only).
//
// capacity is the length of isect_splats; entries from tile_offsets[B*T] on are unspecified. If there are
// more entries, the CPU kernel returns their number and writes no list, and the op fails with both numbers.
// On CUDA the op counts the entries first, for which the host waits, and fails in the same way; `unchecked`,
// it does not: the kernels then list the first `capacity` entries in depth order, with consistent offsets,
// and the caller has to compare the capacity with the number of entries, which it gets from the projection.
//
// The lists depend on the splats alone and not on the number of threads. The splats may come in any order.
// The cost is O(P) for the radix sort, O(tile rows) for the tests and O(I) to write. Counts are 64-bit; P and
// B*T must be below 2^31.
#pragma once
#include "math/tiles.h"

namespace blitzgs {

template <class T> struct IntersectInput {
  const T *means2d, *conics, *opacities, *depths;
  const int32_t* camera_ids;
  const int64_t* ids;
  int64_t n_splats;
  TileGrid grid;
  const int64_t* known_splats = nullptr;
};

namespace BLITZGS_BACKEND {
// On CUDA it waits for the device, because the host needs the count.
template <class T> int64_t count_intersections(const IntersectInput<T>& in, Workspace&, CudaStream);
// On CUDA it does not wait for the device, and returns the capacity.
template <class T>
int64_t intersect(const IntersectInput<T>& in, int64_t capacity, int32_t* isect_splats, int64_t* tile_offsets,
                  Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
