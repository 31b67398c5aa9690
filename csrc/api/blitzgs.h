// SPDX-License-Identifier: Apache-2.0
// The ops of the renderer for C++ programs, with names for their arguments and results. They run through
// torch's dispatcher and the stable ABI of LibTorch; link libblitzgs_cpu.so or libblitzgs_cuda.so, which
// registers the ops when it is loaded. csrc/registration.cpp lists all ops, and the headers that it names
// define what they compute. Letters: N Gaussians, B views, P splats (pairs of a Gaussian and a view that sees
// it), U Gaussians visible in some view, I entries of the tiles' lists, D channels.
#pragma once
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <vector>

// Hidden as torch's types are: otherwise GCC warns of every field that is a tensor.
HIDDEN_NAMESPACE_BEGIN(blitzgs, api)

using torch::stable::Tensor;

struct Gaussians {
  Tensor means;              // [N, 3], world units
  Tensor quats;              // [N, 4], (w, x, y, z)
  Tensor scales;             // [N, 3], standard deviations, or their logarithms if ProjectOptions::raw
  Tensor opacities;          // [N], in [0, 1], or logits if ProjectOptions::raw
  std::optional<Tensor> sh;  // [N, K, 3]
};

struct Cameras {
  Tensor viewmats;  // [B, 4, 4], world to camera
  Tensor Ks;        // [B, 3, 3], pixels
};

struct ProjectOptions {
  std::int64_t width, height;  // pixels
  std::int64_t tile_size = 16;
  std::int64_t sh_degree = 0;
  double near_plane = 0.01, far_plane = 1e10;  // world units
  double eps2d = 0.3;                          // variance added to both screen axes, pixels squared
  double radius_clip = 0;                      // splats whose radii are at most this are dropped, px
  bool antialiased = false;
  bool raw = false;          // whether scales and opacities are before their activation
  std::vector<double> fade;  // empty: opacities do not fade with octree levels
};

struct Splats {
  Tensor gaussian_ids;   // int32 [P]
  Tensor camera_ids;     // int32 [P]
  Tensor visible_ids;    // int32 [U], ascending
  Tensor splat_offsets;  // int32 [U + 1]
  Tensor means2d;        // [P, 2], pixels
  Tensor conics;         // [P, 3], inverse 2D covariances (a, b, c)
  Tensor depths;         // [P]
  Tensor opacities;      // [P]
  Tensor colors;         // [P, 3]; [0, 3] without sh
  Tensor radii;          // int32 [P, 2]
  Tensor tiles_touched;  // int32 [P]
};

struct TileGrid {
  std::int64_t n_cameras, width, height;  // B, pixels
  std::int64_t tile_size = 16;
  std::int64_t tile_begin = 0, tile_end = -1;  // the range of tiles to composite; -1: all
};

struct TileLists {
  Tensor isect_splats;  // int32 [I], the splats of each tile, front to back
  Tensor tile_offsets;  // int64 [B T + 1]
};

struct Images {
  Tensor renders;                              // [B, H, W, D]
  Tensor transmittances;                       // [B, H, W]; alpha is 1 - transmittance
  Tensor last_ids, packed_splats, tile_order;  // what the backward pass reads
};

struct SplatGradients {
  Tensor means2d;           // [P, 2]
  Tensor conics;            // [P, 3]
  Tensor opacities;         // [P]
  Tensor colors;            // [P, D]
  Tensor means2d_absolute;  // [P, 2], sums of absolute values over pixels; [0, 2] without them
};

// The gradients of the U Gaussians visible_ids of the splats, or of all N.
struct GaussianGradients {
  Tensor means, quats, scales, opacities;
  Tensor sh;        // [U, K, 3]; empty without sh
  Tensor viewmats;  // [B, 4, 4]; empty unless asked for
};

namespace detail {
// Calls an op that returns so many tensors.
template <std::size_t Results, class... Arguments>
std::array<Tensor, Results> call(const char* op, const Arguments&... arguments) {
  namespace abi = torch::stable::detail;
  std::array<StableIValue, std::max(sizeof...(Arguments), Results)> stack{abi::from(arguments)...};
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher(op, "", stack.data(), TORCH_ABI_VERSION));
  std::array<Tensor, Results> results;
  for (std::size_t i = 0; i < Results; ++i) results[i] = abi::to<Tensor>(stack[i]);
  return results;
}
}  // namespace detail

// Projects all Gaussians into all views; waits for the number of splats.
inline Splats project(const Gaussians& g, const Cameras& cameras, const ProjectOptions& o) {
  std::vector<Tensor> gaussians{g.means, g.quats, g.scales, g.opacities};
  if (g.sh) gaussians.push_back(*g.sh);
  const std::optional<Tensor> none;
  const std::vector<std::int64_t> no_ranks;
  const std::optional<std::int64_t> wait;
  auto r = detail::call<14>("blitzgs::project_fwd", gaussians, cameras.viewmats, cameras.Ks,
                            /*active_ids=*/none, /*active_views=*/none, /*n_active=*/none, /*n_blocks=*/none,
                            /*ids=*/none, /*level=*/none, o.width, o.height, o.tile_size, o.sh_degree,
                            o.near_plane, o.far_plane, o.eps2d, o.radius_clip, o.antialiased, o.raw, o.fade,
                            no_ranks, /*visible_capacity=*/wait, /*splat_capacity=*/wait);
  return {r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10]};
}

// Lists the splats that each tile composites.
inline TileLists intersect(const Splats& s, const TileGrid& grid) {
  const std::optional<Tensor> none;
  constexpr std::int64_t kCountThem = -1;
  auto r = detail::call<2>("blitzgs::intersect", s.means2d, s.conics, s.opacities, s.depths, s.camera_ids,
                           /*ids=*/none, grid.n_cameras, grid.width, grid.height, grid.tile_size,
                           grid.tile_begin, grid.tile_end, kCountThem, /*n_splats=*/none,
                           /*unchecked=*/false);
  return {r[0], r[1]};
}

// Composites colors [P, D] of the splats before backgrounds [B, D], or black.
inline Images rasterize(const Splats& s, const Tensor& colors, const TileLists& lists, const TileGrid& grid,
                        const std::optional<Tensor>& backgrounds = std::nullopt) {
  const std::optional<Tensor> none;
  auto r = detail::call<7>("blitzgs::rasterize_fwd", s.means2d, s.conics, s.opacities, colors, backgrounds,
                           lists.isect_splats, lists.tile_offsets, grid.n_cameras, grid.width, grid.height,
                           grid.tile_size, grid.tile_begin, grid.tile_end, /*clear_rest=*/true,
                           /*backward_follows=*/false, /*n_splats=*/none);
  return {r[0], r[1], r[2], r[4], r[5]};
}

// The gradients of the splats from that of the images, v_renders [B, H, W, D]. The arguments are those of
// `rasterize`.
inline SplatGradients rasterize_backward(const Splats& s, const Tensor& colors, const TileLists& lists,
                                         const TileGrid& grid, const Images& images, const Tensor& v_renders,
                                         const std::optional<Tensor>& backgrounds = std::nullopt,
                                         bool absolute = false) {
  const std::optional<Tensor> none;
  const std::vector<Tensor> splats{s.means2d, s.conics, s.opacities, colors};
  const std::vector<Tensor> listed{lists.isect_splats, lists.tile_offsets};
  const std::vector<Tensor> composited{images.transmittances, images.last_ids, images.packed_splats,
                                       images.tile_order};
  auto r = detail::call<5>("blitzgs::rasterize_bwd", splats, backgrounds, listed, composited, v_renders,
                           /*v_alphas=*/none, grid.n_cameras, grid.width, grid.height, grid.tile_size,
                           grid.tile_begin, grid.tile_end, absolute, /*deterministic=*/false,
                           /*gradients=*/none);
  return {r[0], r[1], r[2], r[3], r[4]};
}

// The gradients of the Gaussians from those of their splats. The other arguments are those of `project`.
inline GaussianGradients project_backward(const Gaussians& g, const Cameras& cameras, const ProjectOptions& o,
                                          const Splats& s, const SplatGradients& v, bool of_viewmats = false,
                                          bool of_all = false) {
  std::vector<Tensor> gaussians{g.means, g.quats, g.scales, g.opacities};
  std::vector<Tensor> v_splats{v.means2d, v.conics, v.opacities};
  if (g.sh) {
    gaussians.push_back(*g.sh);
    v_splats.push_back(v.colors);
  }
  const std::optional<Tensor> none;
  auto r = detail::call<6>(
      "blitzgs::project_bwd", gaussians, cameras.viewmats, cameras.Ks, /*scale_reg=*/none,
      /*opacity_reg=*/none, s.camera_ids, s.visible_ids, s.splat_offsets, /*level=*/none, o.width, o.height,
      o.tile_size, o.sh_degree, o.near_plane, o.far_plane, o.eps2d, o.radius_clip, o.antialiased, o.raw,
      o.fade, v_splats, /*v_depths=*/none, of_viewmats, of_all);
  return {r[0], r[1], r[2], r[3], r[4], r[5]};
}

HIDDEN_NAMESPACE_END(blitzgs, api)
