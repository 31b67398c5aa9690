// SPDX-License-Identifier: Apache-2.0
// Intersection: which splats each tile composites, front to back.
//
// Splat p (a splat in camera camera_ids[p]) is listed in tile t of that camera iff for_each_tile() of
// math/tiles.h visits it. Within a tile the splats are ordered by (depth, id); without ids by (depth, splat).
// -0 and 0 are different depths; lists are undefined if a depth is NaN.
//
//   means2d [P, 2] pixels, conics [P, 3], opacities [P], depths [P], camera_ids int32 [P], ids int64 [P] or
//   null  ->  isect_splats int32 [I] splat indices, tile_offsets int64 [B*T + 1] with T = tiles_y * tiles_x:
//   tile t's list is isect_splats[tile_offsets[t] .. tile_offsets[t + 1]). Tiles that grid does not own have
//   empty lists.
//
// known_splats: null, or the number of splats in device memory (common/kernel.h; CUDA alone).
//
// capacity is the length of isect_splats; entries from tile_offsets[B*T] on are left unspecified. If there
// are more entries than that, the CPU kernel returns their number and writes no list, and the op fails with
// both numbers. On CUDA the op counts them first, which is a wait, and fails likewise. The CUDA kernel itself
// then lists the first entries in depth order, in consistent lists and offsets: so does the op where the
// caller asks for no check because it learns the number while the device works (`unchecked`).
//
// Deterministic: the lists depend on the splats alone, never on threads. Splat order need not follow depth.
// O(P) for the radix sort, O(tile rows) for the tests, O(I) to write. Counts are 64-bit; P and
// B*T < 2^31.
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "math/tiles.h"

namespace blitzgs {

template <class T>
struct IntersectInput {
  const T* means2d;
  const T* conics;
  const T* opacities;
  const T* depths;
  const std::int32_t* camera_ids;
  const std::int64_t* ids;
  std::int64_t n_splats;
  TileGrid grid;
  const std::int64_t* known_splats = nullptr;
};

namespace cpu {
template <class T>
std::int64_t count_intersections(const IntersectInput<T>& in, Workspace&, CudaStream);
template <class T>
std::int64_t intersect(const IntersectInput<T>& in, std::int64_t capacity, std::int32_t* isect_splats,
                       std::int64_t* tile_offsets, Workspace&, CudaStream);
}  // namespace cpu

namespace cuda {
// Waits for the device: the count is needed on the host.
template <class T>
std::int64_t count_intersections(const IntersectInput<T>& in, Workspace&, CudaStream);
// Returns a count that is exact or at most the capacity, without waiting for the device.
template <class T>
std::int64_t intersect(const IntersectInput<T>& in, std::int64_t capacity, std::int32_t* isect_splats,
                       std::int64_t* tile_offsets, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
