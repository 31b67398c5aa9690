// SPDX-License-Identifier: Apache-2.0
#include "rasterize/rasterize.h"

#include <limits>
#include <tuple>

#include "common/op.h"
#include "common/row_count_op.h"
#include "common/tile_grid_op.h"

namespace blitzgs {
namespace {

// Whether gradients of rows can be left packed.
#ifdef BLITZGS_BACKEND_CUDA
constexpr bool kPacked = true;
#else
constexpr bool kPacked = false;
#endif

// The arguments that forward and backward share, checked and contiguous.
struct Splats {
  Splats(const char* op, const Tensor& means2d_in, const Tensor& conics_in, const Tensor& opacities_in,
         const Tensor& colors_in, const std::optional<Tensor>& backgrounds_in, const Tensor& isect_rows_in,
         const Tensor& tile_offsets_in, const TileGrid& grid_in,
         const std::optional<Tensor>& known_rows = std::nullopt)
      : grid(grid_in), n_rows(means2d_in.size(0)), row_count(checked_row_count(op, known_rows, means2d_in)) {
    check_floating(op, "means2d", means2d_in);
    check_shape(op, "means2d", means2d_in, {n_rows, 2});
    check_shape(op, "conics", conics_in, {n_rows, 3});
    check_shape(op, "row_opacities", opacities_in, {n_rows});
    check_shape(op, "colors", colors_in, {n_rows, -1});
    n_channels = colors_in.size(1);
    STD_TORCH_CHECK(n_rows <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op,
                    ": row indices are 32-bit, got ", n_rows, " rows; render fewer views at once");
    STD_TORCH_CHECK(n_channels > 0 && n_channels <= 4096, "blitzgs::", op,
                    ": colors must have 1 to 4096 channels, got ", n_channels);
    const ScalarType dtype = means2d_in.scalar_type();
    check_dtype(op, "conics", conics_in, dtype);
    check_dtype(op, "row_opacities", opacities_in, dtype);
    check_dtype(op, "colors", colors_in, dtype);
    if (backgrounds_in) {
      check_shape(op, "backgrounds", *backgrounds_in, {grid.n_cameras, n_channels});
      check_dtype(op, "backgrounds", *backgrounds_in, dtype);
      backgrounds = as_contiguous(*backgrounds_in);
    }
    check_shape(op, "isect_rows", isect_rows_in, {-1});
    check_dtype(op, "isect_rows", isect_rows_in, ScalarType::Int);
    check_shape(op, "tile_offsets", tile_offsets_in, {grid.count() + 1});
    check_dtype(op, "tile_offsets", tile_offsets_in, ScalarType::Long);
    means2d = as_contiguous(means2d_in);
    conics = as_contiguous(conics_in);
    opacities = as_contiguous(opacities_in);
    colors = as_contiguous(colors_in);
    isect_rows = as_contiguous(isect_rows_in);
    tile_offsets = as_contiguous(tile_offsets_in);
  }

  template <class T>
  RasterizeInput<T> input() const {
    return {data<T>(means2d),
            data<T>(conics),
            data<T>(opacities),
            data<T>(colors),
            data_or_null<T>(backgrounds),
            data<std::int32_t>(isect_rows),
            data<std::int64_t>(tile_offsets),
            row_count.n_rows,
            static_cast<int>(n_channels),
            grid,
            row_count.known_rows};
  }

  TileGrid grid;
  std::int64_t n_rows, n_channels = 0;  // of the columns
  RowCount row_count;
  Tensor means2d, conics, opacities, colors, isect_rows, tile_offsets;
  std::optional<Tensor> backgrounds;
};

// Zeroes row_gradients, if there are any.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> composite(const Splats& splats,
                                                             std::optional<Tensor> row_gradients,
                                                             bool clear_rest) {
  const TileGrid& grid = splats.grid;
  Tensor renders = make_empty(splats.means2d, {grid.n_cameras, grid.height, grid.width, splats.n_channels});
  Tensor transmittances = make_empty(splats.means2d, {grid.n_cameras, grid.height, grid.width});
  Tensor last_ids = make_empty(splats.means2d, {grid.n_cameras, grid.height, grid.width}, ScalarType::Int);
  Tensor tile_work = make_empty(splats.means2d, {grid.count()}, ScalarType::Int);
  Tensor aux =
      make_empty(splats.means2d,
                 {backend::rasterize_aux_bytes(grid, splats.n_rows, static_cast<int>(splats.n_channels))},
                 ScalarType::Byte);
  DeviceScope scope(splats.means2d);
  dispatch_floating(splats.means2d, [&](auto zero) {
    using T = decltype(zero);
    const RasterizeOutput<T> out{mutable_data<T>(renders),
                                 mutable_data<T>(transmittances),
                                 mutable_data<std::int32_t>(last_ids),
                                 mutable_data<std::int32_t>(tile_work),
                                 row_gradients ? mutable_data<T>(*row_gradients) : nullptr,
                                 clear_rest};
    backend::rasterize_fwd(splats.input<T>(), out, mutable_data<void>(aux), scope.workspace, scope.stream);
  });
  return {renders, transmittances, last_ids, tile_work, aux};
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& row_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_rows, const Tensor& tile_offsets,
    std::int64_t n_cameras, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t tile_begin, std::int64_t tile_end, const std::optional<Tensor>&, bool clear_rest,
    bool backward_follows, const std::optional<Tensor>& known_rows) {
  constexpr const char* kOp = "rasterize_fwd";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, row_opacities, colors, backgrounds, isect_rows, tile_offsets,
                      grid, known_rows);
  const bool packed = kPacked && backward_follows && splats.n_channels <= 4;
  Tensor row_gradients = make_empty(splats.means2d, {packed ? splats.n_rows : 0, kSplatGradient});
  auto composited = composite(splats, packed ? std::optional(row_gradients) : std::nullopt, clear_rest);
  return std::tuple_cat(std::move(composited), std::tuple(row_gradients));
}

// The arguments that the backward ops share, checked and contiguous.
struct Composited {
  Composited(const char* op, const Splats& splats, const Tensor& renders_in, const Tensor& transmittances_in,
             const Tensor& last_ids_in, const Tensor& aux_in, const Tensor& v_renders_in,
             const std::optional<Tensor>& v_alphas_in, std::int64_t width, std::int64_t height)
      : renders(as_contiguous(renders_in)),
        transmittances(as_contiguous(transmittances_in)),
        last_ids(as_contiguous(last_ids_in)),
        v_renders(as_contiguous(v_renders_in)),
        aux(aux_in) {
    const std::int64_t B = splats.grid.n_cameras;
    const ScalarType dtype = splats.means2d.scalar_type();
    for (const auto& [name, tensor] : {std::pair{"renders", &renders}, std::pair{"v_renders", &v_renders}}) {
      check_shape(op, name, *tensor, {B, height, width, splats.n_channels});
      check_dtype(op, name, *tensor, dtype);
    }
    check_shape(op, "transmittances", transmittances, {B, height, width});
    check_dtype(op, "transmittances", transmittances, dtype);
    check_shape(op, "last_ids", last_ids, {B, height, width});
    check_dtype(op, "last_ids", last_ids, ScalarType::Int);
    if (v_alphas_in) {
      check_shape(op, "v_alphas", *v_alphas_in, {B, height, width});
      check_dtype(op, "v_alphas", *v_alphas_in, dtype);
      v_alphas = as_contiguous(*v_alphas_in);
    }
    check_shape(op, "aux", aux, {-1});
    STD_TORCH_CHECK(backend::rasterize_aux_fits(splats.grid, splats.n_rows,
                                                static_cast<int>(splats.n_channels), aux.size(0)) &&
                        reinterpret_cast<std::uintptr_t>(aux.const_data_ptr()) % 64 == 0,
                    "blitzgs::", op, ": aux must be as rasterize_fwd returned it for these tiles and ",
                    splats.n_rows, " rows, or more, got ", aux.size(0), " bytes");
  }

  RasterizeAux own() const { return {data<void>(aux), aux.size(0)}; }

  template <class T>
  RasterizeSaved<T> saved() const {
    return {data<T>(renders), data<T>(transmittances), data<std::int32_t>(last_ids), data<T>(v_renders),
            data_or_null<T>(v_alphas)};
  }

  Tensor renders, transmittances, last_ids, v_renders, aux;
  std::optional<Tensor> v_alphas;
};

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_bwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& row_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_rows, const Tensor& tile_offsets,
    const Tensor& renders, const Tensor& transmittances, const Tensor& last_ids, const Tensor& aux,
    const Tensor& v_renders, const std::optional<Tensor>& v_alphas, std::int64_t n_cameras,
    std::int64_t width, std::int64_t height, std::int64_t tile_size, std::int64_t tile_begin,
    std::int64_t tile_end, bool absgrad, bool deterministic) {
  constexpr const char* kOp = "rasterize_bwd";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, row_opacities, colors, backgrounds, isect_rows, tile_offsets,
                      grid);
  const Composited composited(kOp, splats, renders, transmittances, last_ids, aux, v_renders, v_alphas, width,
                              height);
  const std::int64_t n_rows = splats.n_rows;
  Tensor v_means2d = make_empty(splats.means2d, {n_rows, 2});
  Tensor v_conics = make_empty(splats.means2d, {n_rows, 3});
  Tensor v_opacities = make_empty(splats.means2d, {n_rows});
  Tensor v_colors = make_empty(splats.means2d, {n_rows, splats.n_channels});
  Tensor v_means2d_abs = make_empty(splats.means2d, {absgrad ? n_rows : 0, 2});
  DeviceScope scope(splats.means2d);
  dispatch_floating(splats.means2d, [&](auto zero) {
    using T = decltype(zero);
    const RasterizeGradients<T> gradients{mutable_data<T>(v_means2d), mutable_data<T>(v_conics),
                                          mutable_data<T>(v_opacities), mutable_data<T>(v_colors),
                                          absgrad ? mutable_data<T>(v_means2d_abs) : nullptr};
    backend::rasterize_bwd(splats.input<T>(), composited.saved<T>(), splats.isect_rows.size(0),
                           composited.own(), deterministic, gradients, scope.workspace, scope.stream);
  });
  return {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs};
}

#ifdef BLITZGS_BACKEND_CUDA
void check_packed(const char* op, const Splats& splats, const Tensor& packed) {
  STD_TORCH_CHECK(splats.n_channels <= 4, "blitzgs::", op, ": colors must have 1 to 4 channels, got ",
                  splats.n_channels);
  check_shape(op, "packed", packed, {-1, kSplatGradient});
  STD_TORCH_CHECK(packed.size(0) >= splats.n_rows, "blitzgs::", op, ": packed must have ", splats.n_rows,
                  " rows or more, got ", packed.size(0));
  check_dtype(op, "packed", packed, ScalarType::Float);
  STD_TORCH_CHECK(packed.is_contiguous(), "blitzgs::", op, ": packed must be contiguous");
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd_packed(
    const Tensor& means2d, const Tensor& conics, const Tensor& row_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_rows, const Tensor& tile_offsets,
    std::int64_t n_cameras, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t tile_begin, std::int64_t tile_end, Tensor packed, const std::optional<Tensor>& known_rows) {
  constexpr const char* kOp = "rasterize_fwd_packed_";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, row_opacities, colors, backgrounds, isect_rows, tile_offsets,
                      grid, known_rows);
  check_packed(kOp, splats, packed);
  return composite(splats, packed, false);
}

void rasterize_bwd_packed(const Tensor& means2d, const Tensor& conics, const Tensor& row_opacities,
                          const Tensor& colors, const std::optional<Tensor>& backgrounds,
                          const Tensor& isect_rows, const Tensor& tile_offsets, const Tensor& renders,
                          const Tensor& transmittances, const Tensor& last_ids, const Tensor& aux,
                          const Tensor& v_renders, std::int64_t n_cameras, std::int64_t width,
                          std::int64_t height, std::int64_t tile_size, std::int64_t tile_begin,
                          std::int64_t tile_end, bool deterministic, Tensor packed) {
  constexpr const char* kOp = "rasterize_bwd_packed_";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, row_opacities, colors, backgrounds, isect_rows, tile_offsets,
                      grid);
  check_packed(kOp, splats, packed);
  const Composited composited(kOp, splats, renders, transmittances, last_ids, aux, v_renders, std::nullopt,
                              width, height);
  DeviceScope scope(splats.means2d);
  cuda::rasterize_bwd_packed(splats.input<float>(), composited.saved<float>(), splats.isect_rows.size(0),
                             composited.own(), deterministic, mutable_data<float>(packed), scope.workspace,
                             scope.stream);
}
#endif

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("rasterize_fwd", TORCH_BOX(&blitzgs::rasterize_fwd));
  m.impl("rasterize_bwd", TORCH_BOX(&blitzgs::rasterize_bwd));
#ifdef BLITZGS_BACKEND_CUDA
  m.impl("rasterize_fwd_packed_", TORCH_BOX(&blitzgs::rasterize_fwd_packed));
  m.impl("rasterize_bwd_packed_", TORCH_BOX(&blitzgs::rasterize_bwd_packed));
#endif
}
