// SPDX-License-Identifier: Apache-2.0
#include "rasterize/rasterize.h"

#include <limits>
#include <tuple>

#include "common/op.h"
#include "common/tile_grid_op.h"

namespace blitzgs {
namespace {

// The arguments that forward and backward share, checked and contiguous.
struct Splats {
  Splats(const char* op, const Tensor& means2d_in, const Tensor& conics_in, const Tensor& opacities_in,
         const Tensor& colors_in, const std::optional<Tensor>& backgrounds_in, const Tensor& isect_rows_in,
         const Tensor& tile_offsets_in, const TileGrid& grid_in)
      : grid(grid_in), n_rows(means2d_in.size(0)) {
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
            n_rows,
            static_cast<int>(n_channels),
            grid};
  }

  TileGrid grid;
  std::int64_t n_rows, n_channels = 0;
  Tensor means2d, conics, opacities, colors, isect_rows, tile_offsets;
  std::optional<Tensor> backgrounds;
};

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& row_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_rows, const Tensor& tile_offsets,
    std::int64_t n_cameras, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t tile_begin, std::int64_t tile_end, const std::optional<Tensor>&) {
  constexpr const char* kOp = "rasterize_fwd";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, row_opacities, colors, backgrounds, isect_rows, tile_offsets,
                      grid);
  const std::int64_t n_isects = splats.isect_rows.size(0);
  Tensor renders = make_empty(splats.means2d, {n_cameras, height, width, splats.n_channels});
  Tensor transmittances = make_empty(splats.means2d, {n_cameras, height, width});
  Tensor last_ids = make_empty(splats.means2d, {n_cameras, height, width}, ScalarType::Int);
  Tensor tile_work = make_empty(splats.means2d, {grid.count()}, ScalarType::Int);
  Tensor aux = make_empty(
      splats.means2d,
      {backend::rasterize_aux_bytes(grid, splats.n_rows, n_isects, static_cast<int>(splats.n_channels))},
      ScalarType::Byte);
  DeviceScope scope(splats.means2d);
  dispatch_floating(splats.means2d, [&](auto zero) {
    using T = decltype(zero);
    const RasterizeOutput<T> out{mutable_data<T>(renders), mutable_data<T>(transmittances),
                                 mutable_data<std::int32_t>(last_ids), mutable_data<std::int32_t>(tile_work)};
    backend::rasterize_fwd(splats.input<T>(), out, n_isects, mutable_data<void>(aux), scope.workspace,
                           scope.stream);
  });
  return {renders, transmittances, last_ids, tile_work, aux};
}

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
  const ScalarType dtype = splats.means2d.scalar_type();
  for (const auto& [name, tensor] : {std::pair{"renders", &renders}, std::pair{"v_renders", &v_renders}}) {
    check_shape(kOp, name, *tensor, {n_cameras, height, width, splats.n_channels});
    check_dtype(kOp, name, *tensor, dtype);
  }
  check_shape(kOp, "transmittances", transmittances, {n_cameras, height, width});
  check_dtype(kOp, "transmittances", transmittances, dtype);
  check_shape(kOp, "last_ids", last_ids, {n_cameras, height, width});
  check_dtype(kOp, "last_ids", last_ids, ScalarType::Int);
  std::optional<Tensor> v_alpha_pixels;
  if (v_alphas) {
    check_shape(kOp, "v_alphas", *v_alphas, {n_cameras, height, width});
    check_dtype(kOp, "v_alphas", *v_alphas, dtype);
    v_alpha_pixels = as_contiguous(*v_alphas);
  }
  const Tensor colors_out = as_contiguous(renders), rest = as_contiguous(transmittances),
               last = as_contiguous(last_ids), v_pixels = as_contiguous(v_renders);
  const std::int64_t n_rows = splats.n_rows;
  check_shape(kOp, "aux", aux,
              {backend::rasterize_aux_bytes(grid, n_rows, splats.isect_rows.size(0),
                                            static_cast<int>(splats.n_channels))});
  STD_TORCH_CHECK(reinterpret_cast<std::uintptr_t>(aux.const_data_ptr()) % 64 == 0,
                  "blitzgs::rasterize_bwd: aux must be 64-byte aligned, as rasterize_fwd returned it");
  Tensor v_means2d = make_empty(splats.means2d, {n_rows, 2});
  Tensor v_conics = make_empty(splats.means2d, {n_rows, 3});
  Tensor v_opacities = make_empty(splats.means2d, {n_rows});
  Tensor v_colors = make_empty(splats.means2d, {n_rows, splats.n_channels});
  Tensor v_means2d_abs = make_empty(splats.means2d, {absgrad ? n_rows : 0, 2});
  DeviceScope scope(splats.means2d);
  dispatch_floating(splats.means2d, [&](auto zero) {
    using T = decltype(zero);
    const RasterizeSaved<T> saved{data<T>(colors_out), data<T>(rest), data<std::int32_t>(last),
                                  data<T>(v_pixels), data_or_null<T>(v_alpha_pixels)};
    const RasterizeGradients<T> gradients{mutable_data<T>(v_means2d), mutable_data<T>(v_conics),
                                          mutable_data<T>(v_opacities), mutable_data<T>(v_colors),
                                          absgrad ? mutable_data<T>(v_means2d_abs) : nullptr};
    backend::rasterize_bwd(splats.input<T>(), saved, splats.isect_rows.size(0), data<void>(aux),
                           deterministic, gradients, scope.workspace, scope.stream);
  });
  return {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("rasterize_fwd", TORCH_BOX(&blitzgs::rasterize_fwd));
  m.impl("rasterize_bwd", TORCH_BOX(&blitzgs::rasterize_bwd));
}
