// SPDX-License-Identifier: Apache-2.0
#include "rasterize/rasterize_op.h"

namespace blitzgs {
namespace {

Tensors<6> composite(const ListedSplats& splats, const OptionalTensor& splat_gradients, bool clear_rest) {
  const TileGrid& grid = splats.grid;
  const Tensor& like = splats.means2d;
  const int64_t composited = grid.tile_end - grid.tile_begin;
  const bool orders = backend::rasterize_orders_tiles(grid);
  const auto last_ids = make<int32_t>(like, {grid.n_cameras, grid.height, grid.width}),
             tile_work = make<int32_t>(like, {grid.count()}),
             order = make<int32_t>(like, {orders ? 1 + composited : 0, kTileOrderClasses});
  const auto packed =
      make<uint8_t>(like, {splats.n_splats, backend::rasterize_splat_bytes(int(splats.n_channels))});
  DeviceScope scope(like);
  return dispatch_floating(like, [&]<class T>() -> Tensors<6> {
    const auto renders = make<T>(like, {grid.n_cameras, grid.height, grid.width, splats.n_channels}),
               transmittances = make<T>(like, {grid.n_cameras, grid.height, grid.width});
    const RasterizeOutput<T> out{renders,
                                 transmittances,
                                 last_ids,
                                 tile_work,
                                 splat_gradients ? mutable_data<T>(*splat_gradients) : nullptr,
                                 clear_rest};
    backend::rasterize_fwd(splats.input<T>(), out,
                           {packed, splats.n_splats, order.data_if(orders), composited}, scope.workspace,
                           scope.stream);
    return {renders, transmittances, last_ids, tile_work, packed, order};
  });
}

}  // namespace

Tensors<7> rasterize_fwd(const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities,
                         const Tensor& colors, const OptionalTensor& backgrounds, const Tensor& isect_splats,
                         const Tensor& tile_offsets, BLITZGS_TILES, bool clear_rest, bool backward_follows,
                         const OptionalTensor& known_splats) {
  const TileGrid grid = checked_tile_grid(n_cameras, width, height, tile_size, tile_begin, tile_end);
  ListedSplats splats(means2d, conics, splat_opacities, isect_splats, tile_offsets, grid, known_splats);
  splats.set_colors(colors, backgrounds);
  const bool packed = kOnCuda && backward_follows && splats.n_channels <= 4;
  Tensor splat_gradients = make_empty(splats.means2d, {packed ? splats.n_splats : 0, kSplatGradient});
  auto composited = composite(splats, packed ? std::optional(splat_gradients) : std::nullopt, clear_rest);
  return std::tuple_cat(std::move(composited), std::tuple(splat_gradients));
}

namespace {

// Checks a table of splat gradients that a caller gives (CUDA).
void check_gradients(const ListedSplats& splats, const Tensor& gradients) {
  BLITZGS_CHECK(kOnCuda, "tables of gradients need CUDA");
  BLITZGS_CHECK(splats.n_channels <= 4, "colors must have 1 to 4 channels, got ", splats.n_channels);
  check_in_place("gradients", gradients, ScalarType::Float, {-1, kSplatGradient});
  BLITZGS_CHECK(gradients.size(0) >= splats.n_splats, "gradients must have ", splats.n_splats,
                " splats or more, got ", gradients.size(0));
}

Tensors<5> rasterize_bwd(const TensorList& splats_in, const OptionalTensor& backgrounds,
                         const TensorList& lists, const TensorList& composited, const Tensor& v_renders_in,
                         const OptionalTensor& v_alphas_in, BLITZGS_TILES, bool absgrad, bool deterministic,
                         const OptionalTensor& gradients) {
  check_group("splats (means2d, conics, splat_opacities, colors)", splats_in, 4, 4);
  check_group("lists (isect_splats, tile_offsets)", lists, 2, 2);
  check_group("composited (transmittances, last_ids, packed_splats, tile_order)", composited, 4, 4);
  const TileGrid grid = checked_tile_grid(n_cameras, width, height, tile_size, tile_begin, tile_end);
  ListedSplats splats(splats_in[0], splats_in[1], splats_in[2], lists[0], lists[1], grid);
  splats.set_colors(splats_in[3], backgrounds);
  if (gradients) check_gradients(splats, *gradients);
  BLITZGS_CHECK(!gradients || !v_alphas_in, "v_alphas needs gradients in columns");
  const auto last_ids = checked<int32_t>("last_ids", composited[1], {n_cameras, height, width});
  const auto order = checked_in_place<int32_t>("tile_order", composited[3], {-1, kTileOrderClasses});
  const auto packed = checked_in_place<uint8_t>("packed_splats", composited[2],
                                                {-1, backend::rasterize_splat_bytes(int(splats.n_channels))});
  const bool ordered = order.size(0) > 0;
  // The number of tiles that the forward pass composited.
  const int64_t tiles = ordered ? order.size(0) - 1 : grid.count();
  BLITZGS_CHECK(packed.size(0) >= splats.n_splats && tiles >= grid.tile_end - grid.tile_begin &&
                    reinterpret_cast<std::uintptr_t>(packed.data()) % 64 == 0,
                "packed_splats and tile_order must be as rasterize_fwd returned them, for ", splats.n_splats,
                " splats and ", grid.tile_end - grid.tile_begin, " tiles or more, got ", packed.size(0),
                " and ", tiles);
  const RasterizeAux aux{packed, packed.size(0), order.data_if(ordered), tiles};
  const Tensor& like = splats.means2d;
  const int64_t n_splats = gradients ? 0 : splats.n_splats, n_isects = splats.isect_splats.size(0);
  DeviceScope scope(like);
  return dispatch_floating(like, [&]<class T>() -> Tensors<5> {
    const auto transmittances = checked<T>("transmittances", composited[0], {n_cameras, height, width}),
               v_renders =
                   checked<T>("v_renders", v_renders_in, {n_cameras, height, width, splats.n_channels});
    const auto v_alphas = checked<T>("v_alphas", v_alphas_in, {n_cameras, height, width});
    const RasterizeSaved<T> saved{transmittances, last_ids, v_renders, v_alphas};
    const auto v_means2d = make<T>(like, {n_splats, 2}), v_conics = make<T>(like, {n_splats, 3}),
               v_opacities = make<T>(like, {n_splats}),
               v_colors = make<T>(like, {n_splats, splats.n_channels}),
               v_means2d_abs = make<T>(like, {absgrad ? n_splats : 0, 2});
#ifdef BLITZGS_BACKEND_CUDA
    if (gradients) {
      cuda::rasterize_bwd_packed(splats.input<T>(), saved, n_isects, aux, deterministic, absgrad,
                                 mutable_data<T>(*gradients), scope.workspace, scope.stream);
      return {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs};
    }
#endif
    backend::rasterize_bwd<T>(splats.input<T>(), saved, n_isects, aux, deterministic,
                              {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs.data_if(absgrad)},
                              scope.workspace, scope.stream);
    return {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs};
  });
}

#ifdef BLITZGS_BACKEND_CUDA
Tensors<6> rasterize_fwd_into(const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities,
                              const Tensor& colors, const OptionalTensor& backgrounds,
                              const Tensor& isect_splats, const Tensor& tile_offsets, BLITZGS_TILES,
                              const Tensor& gradients, const OptionalTensor& known_splats) {
  const TileGrid grid = checked_tile_grid(n_cameras, width, height, tile_size, tile_begin, tile_end);
  ListedSplats splats(means2d, conics, splat_opacities, isect_splats, tile_offsets, grid, known_splats);
  splats.set_colors(colors, backgrounds);
  check_gradients(splats, gradients);
  return composite(splats, gradients, false);
}
#endif

Tensors<5> pixel_splats(const Tensor& means2d, const Tensor& conics, const Tensor& opacities,
                        const Tensor& isect_splats, const Tensor& tile_offsets,
                        const OptionalTensor& slots_in, int64_t n_rows, int64_t n_cameras, int64_t width,
                        int64_t height, int64_t tile_size, int64_t strongest) {
  const TileGrid grid = checked_tile_grid(n_cameras, width, height, tile_size, 0, -1);
  const ListedSplats splats(means2d, conics, opacities, isect_splats, tile_offsets, grid);
  const auto slots = checked<int32_t>("slots", slots_in, {n_cameras, height, width});
  BLITZGS_CHECK(strongest >= 0 && strongest < (1 << 24), "strongest must be 0 to 2^24 - 1, got ", strongest);
  BLITZGS_CHECK(slots ? n_rows >= 0 : n_rows == n_cameras * width * height,
                "n_rows must be the number of rows that slots name, and without slots the number of "
                "pixels, got ",
                n_rows);
  const auto counts = make<int32_t>(means2d, {n_rows}), medians = make<int32_t>(means2d, {n_rows}),
             ids = make<int32_t>(means2d, {n_rows, strongest});
  DeviceScope scope(means2d);
  return dispatch_floating(means2d, [&]<class T>() -> Tensors<5> {
    const auto transmittances = make<T>(means2d, {n_rows}), weights = make<T>(means2d, {n_rows, strongest});
    backend::pixel_splats<T>(splats.input<T>(),
                             {slots, n_rows, int(strongest), transmittances, counts, medians, ids, weights},
                             scope.workspace, scope.stream);
    return {transmittances, counts, medians, ids, weights};
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "rasterize_fwd", rasterize_fwd);
  BLITZGS_OP(m, "rasterize_bwd", rasterize_bwd);
  BLITZGS_OP(m, "pixel_splats", pixel_splats);
#ifdef BLITZGS_BACKEND_CUDA
  BLITZGS_OP(m, "rasterize_fwd_", rasterize_fwd_into);
#endif
}
