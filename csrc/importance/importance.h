// SPDX-License-Identifier: Apache-2.0
// The contributions of splats to the image, for the importance pass (BlitzGS, section 3.2: w = sum of
// alpha T, a = number of pixels). Compositing is that of rasterize/rasterize.h, without colours. The sums of
// a splat are over the pixels at which it is composited:
//   weights = sum of u, u = round(2^32 alpha T)   int64 [P], u to the nearest integer, ties to even
//   pixels  = number of these pixels              int32 [P]
//   squares = sum of floor(u^2 / 2^32)            int64 [P], which is (alpha T)^2 in the same units; optional
//
//   means2d [P, 2], conics [P, 3], opacities [P], isect_splats and tile_offsets from intersect  ->  the sums
//   over the tiles [tile_begin, tile_end). Splats in no list get zeros.
//
// The sums are exact: alpha T of a pixel has the bits with which the backend renders the pixel (with the same
// tile size), and the sums are integers, so tile ranges, ranks, threads, atomics and repetition change no
// bit. An alpha T is at least 1e-4 / 255, so it is never rounded to zero, and below 1, so a sum over 2^31
// pixels fits. CPU and CUDA agree to the rounding of alpha. The cost is O(entries processed x pixels of the
// splat).
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "math/tiles.h"

namespace blitzgs {

inline constexpr std::int64_t kContributionScale = std::int64_t{1} << 32;  // the number of units in 1

template <class T>
struct ContributionInput {
  const T* means2d;
  const T* conics;
  const T* opacities;
  const std::int32_t* isect_splats;
  const std::int64_t* tile_offsets;
  std::int64_t n_splats;
  TileGrid grid;
  const std::int64_t* known_splats = nullptr;  // null, or the number of splats (common/kernel.h; CUDA only)
};

struct ContributionSums {
  std::int64_t* weights;
  std::int32_t* pixels;
  std::int64_t* squares;  // null: not wanted
};

namespace BLITZGS_BACKEND {
template <class T>
void contributions(const ContributionInput<T>& in, const ContributionSums& sums, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
