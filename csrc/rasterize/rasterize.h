// SPDX-License-Identifier: Apache-2.0
// Rasterisation: alpha compositing of each tile's list, front to back, as docs/image.md defines it (sections
// 3 and 5; Kerbl et al. 2023, Eq. 3), and its gradient. Culling inside the kernels is conservative. They
// evaluate
//   q = a dx^2 + 2 b dx dy + c dy^2,  (dx, dy) = pixel centre - mean2d,  conic = (a, b, c)
// through factor_conic() of math/tiles.h, whose rounding the slack of the tile test covers.
//
//   means2d [P, 2], conics [P, 3], opacities [P], colors [P, D], backgrounds [B, D] or null, isect_splats and
//   tile_offsets from intersect  ->  renders [B, H, W, D]; transmittances [B, H, W] (final T; alpha = 1 - T);
//   last_ids int32 [B, H, W]: 1 + index in the tile's list of the last composited entry, 0 for none;
//   tile_work int32 [B*T], the cost of each tile: the list entries processed until every pixel of the tile
//   had ended, or the list was at its end. With clear_rest, the pixels of unowned tiles are zero in all
//   outputs, transmittance included; without it they are not written.
//
// Exactness: a pixel depends only on its tile's list and the splats in it. The range of tiles, the position
// in the batch, the number of threads and (CPU) the instruction set therefore change no bit. CPU and CUDA
// agree to rounding.
//
// Gradients, given v_renders [B, H, W, D] and optionally v_alphas [B, H, W]: per splat v_means2d [P, 2],
// v_conics [P, 3] (of a, b, c as three independent numbers), v_opacities [P], v_colors [P, D], and with
// absgrad v_means2d_abs [P, 2]. They are sums over the pixels at which the splat is composited:
//   w = alpha T,   g = dL/d(ln alpha) = w (v . color - behind),   v = v_renders of the pixel
//   behind = v . (colour of all that is behind the splat, as seen with T = 1), with v_alpha subtracted from
//            v . background
//   v_colors      = sum of w v
//   v_opacities   = sum of g / opacity
//   v_means2d     = sum of g (a dx + b dy, b dx + c dy)
//   v_means2d_abs = sum of the absolute values of these terms (AbsGS, Ye et al. 2024)
//   v_conics      = -sum of g (dx^2 / 2, dx dy, dy^2 / 2)
// g is 0 where min(0.99, .) clips; the order, the cut at 1/255 and the end of a pixel count as constants. The
// caller computes the gradient of the background, the sum over pixels of v_renders * T. Splats in no list get
// zeros. v_renders of unowned tiles are not read. With known_splats (common/kernel.h), gradients beyond that
// number are unspecified, and the backward pass may be called with just these splats.
//
// The CPU gradient is bitwise repeatable for any number of threads: there is one partial sum per splat and
// tile, and these are added in the order of the tiles. The CUDA gradient is repeatable if `deterministic` is
// set. The cost is O(entries processed x pixels of the splat).
#pragma once
#include "math/tiles.h"

namespace blitzgs {

template <class T> struct RasterizeInput {
  const T *means2d, *conics, *opacities, *colors;
  const T* backgrounds;  // null: black
  const int32_t* isect_splats;
  const int64_t* tile_offsets;
  int64_t n_splats;
  int n_channels;
  TileGrid grid;
  const int64_t* known_splats = nullptr;  // null: n_splats
};

template <class T> struct RasterizeOutput {
  T *renders, *transmittances;
  int32_t *last_ids, *tile_work;
  T* splat_gradients;  // null, or [P] SplatGradient that forward sets to zero (CUDA, up to four channels)
  bool clear_rest;
};

template <class T> struct RasterizeSaved {
  const T* transmittances;
  const int32_t* last_ids;
  const T* v_renders;
  const T* v_alphas;  // null: zero
};

template <class T> struct RasterizeGradients {
  T *v_means2d, *v_conics, *v_opacities, *v_colors;
  T* v_means2d_abs;  // null: not wanted
};

// The number of classes of list length by which CUDA orders tiles (tile_order.cuh).
inline constexpr int kTileOrderClasses = 16;

// Memory that forward fills for backward besides its outputs, in the layout of the backend. Backward may be
// called with fewer splats than forward had capacity for, and for fewer tiles than forward composited.
struct RasterizeAux {
  void* packed;        // the packed splats, splats * rasterize_splat_bytes() bytes, 64-byte aligned
  int64_t splats;      // the capacity of forward
  int32_t* order;      // [1 + composited, kTileOrderClasses] of tile_order.cuh; null: tiles by their numbers
  int64_t composited;  // the number of composited tiles
};

// Which splats each pixel composites. Compositing is as above, without colours, so alpha and T of
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
// The cost is that of compositing without colours, and O(strongest) for each of the strongest so far.
template <class T> struct PixelSplats {
  const int32_t* slots;  // null: a row for each pixel
  int64_t rows;
  int strongest;
  T* transmittances;
  int32_t *counts, *medians, *ids;
  T* weights;
};

namespace BLITZGS_BACKEND {
int64_t rasterize_splat_bytes(int n_channels);
// Whether forward leaves an order of the tiles that it composites.
bool rasterize_orders_tiles(const TileGrid& grid);
template <class T>
void rasterize_fwd(const RasterizeInput<T>& in, const RasterizeOutput<T>& out, const RasterizeAux& aux,
                   Workspace&, CudaStream);
template <class T>
void rasterize_bwd(const RasterizeInput<T>& in, const RasterizeSaved<T>& saved, int64_t n_isects,
                   const RasterizeAux& aux, bool deterministic, const RasterizeGradients<T>& gradients,
                   Workspace&, CudaStream);
// (CUDA) rasterize_bwd that adds the gradients to the table `packed` [P] of SplatGradient.
void rasterize_bwd_packed(const RasterizeInput<float>& in, const RasterizeSaved<float>& saved,
                          int64_t n_isects, const RasterizeAux& aux, bool deterministic, bool absolute,
                          float* packed, Workspace&, CudaStream);
template <class T>
void pixel_splats(const RasterizeInput<T>& in, const PixelSplats<T>& out, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

// Internal linkage: the CPU compiles this with and without AVX2.
namespace {

constexpr float kMedianTransmittance = 0.5f;

// The row of a pixel; negative: none.
template <class T> BLITZGS_HD int64_t row_of(const PixelSplats<T>& out, int64_t pixel) {
  if (!out.slots) return pixel;
  const int64_t slot = out.slots[pixel];
  return slot < out.rows ? slot : -1;
}

// Adds a splat behind the first `count` of a pixel to its `most` > 0 strongest. Returns the weight that the
// next splat must exceed to be one of them.
template <class T>
BLITZGS_HD T keep_strongest(int32_t* ids, T* weights, int most, int32_t count, int32_t id, T weight) {
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
