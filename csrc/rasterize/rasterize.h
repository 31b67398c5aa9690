// SPDX-License-Identifier: Apache-2.0
// Rasterisation: alpha compositing of each tile's list, front to back, and its gradient.
//
// Per pixel with centre (i + 0.5, j + 0.5), over the tile's list in order, T = 1 at the start:
//   q     = a dx^2 + 2 b dx dy + c dy^2,  (dx, dy) = pixel centre - mean2d,  conic = (a, b, c)
//   alpha = min(0.99, opacity * exp(-q / 2));           skipped unless alpha >= 1/255
//   if T (1 - alpha) < 1e-4 the pixel ends and this splat is not composited
//   color += alpha T splat_color;  T *= 1 - alpha
// and at the end color += T background. No other cut: culling inside the kernel is conservative (q is best
// evaluated through factor_conic() of math/tiles.h, which the tile test's slack is made for).
//
//   means2d [P, 2], conics [P, 3], opacities [P], colors [P, D], backgrounds [B, D] or null, isect_splats and
//   tile_offsets from intersect  ->  renders [B, H, W, D]; transmittances [B, H, W] (final T; alpha = 1 - T);
//   last_ids int32 [B, H, W]: 1 + index in the tile's list of the last composited entry, 0 for none;
//   tile_work int32 [B*T]: list entries processed before every pixel of the tile had ended (or the list
//   had): what the tile cost. Pixels of unowned tiles are zero in all outputs, transmittance included, with
//   clear_rest; otherwise they are not written.
//
// Exact: a pixel depends on its tile's list and the splats in it alone, so tile ranges, batch position,
// threads and (CPU) the instruction set change no bit. The CPU float32 kernel does the same operations with
// and without AVX2. CPU and CUDA agree to rounding.
//
// Gradients, given v_renders [B, H, W, D] and optionally v_alphas [B, H, W]: per splat v_means2d [P, 2],
// v_conics [P, 3] (of a, b, c as three independent numbers), v_opacities [P], v_colors [P, D], and with
// absgrad v_means2d_abs [P, 2] = sum over pixels of |that pixel's gradient of mean2d| per axis. Zero where
// min(0.99, .) clips; the order, the cut at 1/255 and the end of a pixel are constants. The gradient of the
// background is sum over pixels of v_renders * T, left to the caller. Splats in no list get zeros. v_renders
// of unowned tiles are not read.
//
// Forward may be queued with room for more splats than there are (known_splats, common/kernel.h; CUDA
// alone): it packs, and zeroes gradients of, those that are there; gradients behind them are unspecified.
// Backward may then be given just these splats.
//
// The CPU gradient is bitwise repeatable for any number of threads: one partial sum per (splat, tile), added
// in the order of the tiles. CUDA: when deterministic is set. O(entries processed x pixels of the splat).
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "math/tiles.h"

namespace blitzgs {

template <class T>
struct RasterizeInput {
  const T* means2d;
  const T* conics;
  const T* opacities;
  const T* colors;
  const T* backgrounds;  // null: black
  const std::int32_t* isect_splats;
  const std::int64_t* tile_offsets;
  std::int64_t n_splats;
  int n_channels;
  TileGrid grid;
  const std::int64_t* known_splats = nullptr;
};

template <class T>
struct RasterizeOutput {
  T* renders;
  T* transmittances;
  std::int32_t* last_ids;
  std::int32_t* tile_work;
  T* splat_gradients;  // null, or [P] SplatGradient to be zeroed; up to four channels on CUDA
  bool clear_rest;
};

template <class T>
struct RasterizeSaved {
  const T* transmittances;
  const std::int32_t* last_ids;
  const T* v_renders;
  const T* v_alphas;  // null: zero
};

template <class T>
struct RasterizeGradients {
  T* v_means2d;
  T* v_conics;
  T* v_opacities;
  T* v_colors;
  T* v_means2d_abs;  // null: not wanted
};

// Tiles composited in no plain order are listed by class of length (CUDA), so many numbers for each tile.
inline constexpr int kTileOrderClasses = 16;

// What forward leaves for backward besides its outputs, in the backend's own layout. Backward may have fewer
// splats than forward had room for, and may differentiate fewer tiles than were composited.
struct RasterizeAux {
  void* packed;         // splats as the kernels read them, splats * rasterize_splat_bytes(), 64-byte aligned
  std::int64_t splats;  // that forward had room for
  std::int32_t* order;  // [1 + composited, kTileOrderClasses], or null: in the order of their numbers
  std::int64_t composited;  // tiles
};

namespace cpu {
std::int64_t rasterize_splat_bytes(int n_channels);
// Whether forward leaves an order of the tiles that it composites.
bool rasterize_orders_tiles(const TileGrid& grid);
template <class T>
void rasterize_fwd(const RasterizeInput<T>& in, const RasterizeOutput<T>& out, const RasterizeAux& aux,
                   Workspace&, CudaStream);
template <class T>
void rasterize_bwd(const RasterizeInput<T>& in, const RasterizeSaved<T>& saved, std::int64_t n_isects,
                   const RasterizeAux& aux, bool deterministic, const RasterizeGradients<T>& gradients,
                   Workspace&, CudaStream);
}  // namespace cpu

namespace cuda {
std::int64_t rasterize_splat_bytes(int n_channels);
// Whether forward leaves an order of the tiles that it composites.
bool rasterize_orders_tiles(const TileGrid& grid);
template <class T>
void rasterize_fwd(const RasterizeInput<T>& in, const RasterizeOutput<T>& out, const RasterizeAux& aux,
                   Workspace&, CudaStream);
template <class T>
void rasterize_bwd(const RasterizeInput<T>& in, const RasterizeSaved<T>& saved, std::int64_t n_isects,
                   const RasterizeAux& aux, bool deterministic, const RasterizeGradients<T>& gradients,
                   Workspace&, CudaStream);
void rasterize_bwd_packed(const RasterizeInput<float>& in, const RasterizeSaved<float>& saved,
                          std::int64_t n_isects, const RasterizeAux& aux, bool deterministic, bool absolute,
                          float* packed, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
