// SPDX-License-Identifier: Apache-2.0
// Which splats each pixel composites. Compositing is that of rasterize.h, without colours, so alpha and T of
// a pixel have the bits with which the backend renders it (with the same tile size). Per pixel, over the
// splats that it composites, front to back:
//   transmittance  T behind the last of them, 1 if there are none
//   count          their number
//   median         the last splat with T > 0.5 in front of it: the one that takes T to 0.5 or below, or else
//                  the last of all; -1 if there are none
//   ids, weights   the `strongest` splats of the largest alpha T, front to back, and their alpha T; of equal
//                  ones, those in front. Padded with -1 and 0. All splats if there are no more than
//                  `strongest`.
//
//   means2d [P, 2], conics [P, 3], opacities [P], isect_splats and tile_offsets from intersect, slots int32
//   [B, H, W] or null  ->  transmittances [R], counts and medians int32 [R], ids int32 and weights
//   [R, strongest]. Row slots[b, y, x] of the results is that of a pixel; a slot outside [0, R) is no row.
//   Rows without a pixel are not written. Without slots, the rows are the pixels, R = B H W.
//
// The cost is that of compositing without colours, and O(strongest) for each splat that is among the
// strongest so far.
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "rasterize/rasterize.h"

namespace blitzgs {

template <class T>
struct PixelSplats {
  const std::int32_t* slots;  // null: a row for each pixel
  std::int64_t rows;
  int strongest;
  T* transmittances;
  std::int32_t *counts, *medians, *ids;
  T* weights;
};

namespace BLITZGS_BACKEND {
template <class T>
void pixel_splats(const RasterizeInput<T>& in, const PixelSplats<T>& out, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

// Internal linkage: the CPU compiles this with and without AVX2.
namespace {

constexpr float kMedianTransmittance = 0.5f;

// The row of a pixel; negative: none.
template <class T>
BLITZGS_HD std::int64_t row_of(const PixelSplats<T>& out, std::int64_t pixel) {
  if (!out.slots) return pixel;
  const std::int64_t slot = out.slots[pixel];
  return slot < out.rows ? slot : -1;
}

// Adds a splat behind the first `count` of a pixel to its `most` > 0 strongest. Returns the weight that the
// next splat must exceed to be one of them.
template <class T>
BLITZGS_HD T keep_strongest(std::int32_t* ids, T* weights, int most, std::int32_t count, std::int32_t id,
                            T weight) {
  int end = count < most ? count : most;
  if (end == most) {
    int weakest = 0;
    for (int i = 1; i < most; ++i) weakest = weights[i] <= weights[weakest] ? i : weakest;
    if (!(weight > weights[weakest])) return weights[weakest];
    for (end = weakest; end + 1 < most; ++end) {
      ids[end] = ids[end + 1];
      weights[end] = weights[end + 1];
    }
  }
  ids[end] = id;
  weights[end] = weight;
  if (end + 1 < most) return T(0);
  T least = weights[0];
  for (int i = 1; i < most; ++i) least = weights[i] < least ? weights[i] : least;
  return least;
}

}  // namespace
}  // namespace blitzgs
