// SPDX-License-Identifier: Apache-2.0
#include "rasterize/rasterize_op.h"

#include <tuple>

namespace blitzgs {
namespace {

// Whether the backend has the packed table of splat gradients.
#ifdef BLITZGS_BACKEND_CUDA
constexpr bool kPacked = true;
#else
constexpr bool kPacked = false;
#endif

// The arguments that forward and backward share, checked and contiguous.
struct Splats : ListedSplats {
  Splats(const char* op, const Tensor& means2d_in, const Tensor& conics_in, const Tensor& opacities_in,
         const Tensor& colors_in, const std::optional<Tensor>& backgrounds_in, const Tensor& isect_splats_in,
         const Tensor& tile_offsets_in, const TileGrid& grid_in,
         const std::optional<Tensor>& known_splats = std::nullopt)
      : ListedSplats(op, means2d_in, conics_in, opacities_in, isect_splats_in, tile_offsets_in, grid_in,
                     known_splats) {
    colors = checked(op, "colors", colors_in, means2d.scalar_type(), {n_splats, -1});
    n_channels = colors.size(1);
    BLITZGS_CHECK(n_channels > 0 && n_channels <= 4096, op, "colors must have 1 to 4096 channels, got ",
                  n_channels);
    backgrounds =
        checked(op, "backgrounds", backgrounds_in, colors.scalar_type(), {grid.n_cameras, n_channels});
  }

  template <class T>
  RasterizeInput<T> input() const {
    RasterizeInput<T> in = ListedSplats::input<T>();
    in.colors = data<T>(colors);
    in.backgrounds = data_or_null<T>(backgrounds);
    in.n_channels = static_cast<int>(n_channels);
    return in;
  }

  std::int64_t n_channels = 0;
  Tensor colors;
  std::optional<Tensor> backgrounds;
};

using CompositedTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

// Runs the forward pass. It sets splat_gradients to zero if they are given.
CompositedTensors composite(const Splats& splats, std::optional<Tensor> splat_gradients, bool clear_rest) {
  const TileGrid& grid = splats.grid;
  Tensor renders = make_empty(splats.means2d, {grid.n_cameras, grid.height, grid.width, splats.n_channels});
  Tensor transmittances = make_empty(splats.means2d, {grid.n_cameras, grid.height, grid.width});
  Tensor last_ids = make_empty(splats.means2d, {grid.n_cameras, grid.height, grid.width}, ScalarType::Int);
  Tensor tile_work = make_empty(splats.means2d, {grid.count()}, ScalarType::Int);
  const std::int64_t composited = grid.tile_end - grid.tile_begin;
  Tensor packed = make_empty(
      splats.means2d, {splats.n_splats, backend::rasterize_splat_bytes(static_cast<int>(splats.n_channels))},
      ScalarType::Byte);
  Tensor order = make_empty(splats.means2d,
                            {backend::rasterize_orders_tiles(grid) ? 1 + composited : 0, kTileOrderClasses},
                            ScalarType::Int);
  const RasterizeAux aux{mutable_data<void>(packed), splats.n_splats,
                         order.size(0) > 0 ? mutable_data<std::int32_t>(order) : nullptr, composited};
  DeviceScope scope(splats.means2d);
  dispatch_floating(splats.means2d, [&]<class T>() {
    const RasterizeOutput<T> out{mutable_data<T>(renders),
                                 mutable_data<T>(transmittances),
                                 mutable_data<std::int32_t>(last_ids),
                                 mutable_data<std::int32_t>(tile_work),
                                 splat_gradients ? mutable_data<T>(*splat_gradients) : nullptr,
                                 clear_rest};
    backend::rasterize_fwd(splats.input<T>(), out, aux, scope.workspace, scope.stream);
  });
  return {renders, transmittances, last_ids, tile_work, packed, order};
}

}  // namespace

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_splats, const Tensor& tile_offsets,
    std::int64_t n_cameras, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t tile_begin, std::int64_t tile_end, bool clear_rest, bool backward_follows,
    const std::optional<Tensor>& known_splats) {
  constexpr const char* kOp = "rasterize_fwd";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, splat_opacities, colors, backgrounds, isect_splats, tile_offsets,
                      grid, known_splats);
  const bool packed = kPacked && backward_follows && splats.n_channels <= 4;
  Tensor splat_gradients = make_empty(splats.means2d, {packed ? splats.n_splats : 0, kSplatGradient});
  auto composited = composite(splats, packed ? std::optional(splat_gradients) : std::nullopt, clear_rest);
  return std::tuple_cat(std::move(composited), std::tuple(splat_gradients));
}

namespace {

// Makes a Splats of the groups of arguments of the backward ops: splats (means2d, conics, splat_opacities,
// colors) and lists (isect_splats, tile_offsets).
Splats backward_splats(const char* op, const std::vector<Tensor>& splats,
                       const std::optional<Tensor>& backgrounds, const std::vector<Tensor>& lists,
                       const TileGrid& grid) {
  BLITZGS_CHECK(splats.size() == 4 && lists.size() == 2, op,
                "splats must be (means2d, conics, splat_opacities, colors) and lists (isect_splats, "
                "tile_offsets), got ",
                splats.size(), " and ", lists.size(), " tensors");
  return {op, splats[0], splats[1], splats[2], splats[3], backgrounds, lists[0], lists[1], grid};
}

// The outputs of the forward pass that the backward ops read, (transmittances, last_ids, packed_splats,
// tile_order), and the gradients of the images, checked and contiguous.
struct Composited {
  Composited(const char* op, const Splats& splats, const std::vector<Tensor>& composited,
             const Tensor& v_renders_in, const std::optional<Tensor>& v_alphas_in)
      : grid_count(splats.grid.count()) {
    BLITZGS_CHECK(composited.size() == 4, op,
                  "composited must be (transmittances, last_ids, packed_splats, tile_order), got ",
                  composited.size(), " tensors");
    packed = composited[2];
    order = composited[3];
    const TileGrid& grid = splats.grid;
    const std::int64_t B = grid.n_cameras, height = grid.height, width = grid.width;
    const ScalarType dtype = splats.means2d.scalar_type();
    v_renders = checked(op, "v_renders", v_renders_in, dtype, {B, height, width, splats.n_channels});
    transmittances = checked(op, "transmittances", composited[0], dtype, {B, height, width});
    last_ids = checked(op, "last_ids", composited[1], ScalarType::Int, {B, height, width});
    v_alphas = checked(op, "v_alphas", v_alphas_in, dtype, {B, height, width});
    check_in_place(op, "packed_splats", packed, ScalarType::Byte,
                   {-1, backend::rasterize_splat_bytes(static_cast<int>(splats.n_channels))});
    check_in_place(op, "tile_order", order, ScalarType::Int, {-1, kTileOrderClasses});
    BLITZGS_CHECK(packed.size(0) >= splats.n_splats && tiles() >= grid.tile_end - grid.tile_begin &&
                      reinterpret_cast<std::uintptr_t>(packed.const_data_ptr()) % 64 == 0,
                  op, "packed_splats and tile_order must be as rasterize_fwd returned them, ", "for ",
                  splats.n_splats, " splats and ", grid.tile_end - grid.tile_begin, " tiles or more, got ",
                  packed.size(0), " and ", tiles());
  }

  RasterizeAux aux() const {
    return {const_cast<void*>(packed.const_data_ptr()), packed.size(0),
            order.size(0) > 0 ? const_cast<std::int32_t*>(data<std::int32_t>(order)) : nullptr, tiles()};
  }

  template <class T>
  RasterizeSaved<T> saved() const {
    return {data<T>(transmittances), data<std::int32_t>(last_ids), data<T>(v_renders),
            data_or_null<T>(v_alphas)};
  }

  Tensor transmittances, last_ids, v_renders, packed, order;
  std::optional<Tensor> v_alphas;
  std::int64_t grid_count;

 private:
  // The number of tiles that the forward pass composited.
  std::int64_t tiles() const { return order.size(0) > 0 ? order.size(0) - 1 : grid_count; }
};

// Checks a table of splat gradients that a caller gives (CUDA).
void check_gradients(const char* op, const Splats& splats, const Tensor& gradients) {
  BLITZGS_CHECK(kPacked, op, "tables of gradients need CUDA");
  BLITZGS_CHECK(splats.n_channels <= 4, op, "colors must have 1 to 4 channels, got ", splats.n_channels);
  check_in_place(op, "gradients", gradients, ScalarType::Float, {-1, kSplatGradient});
  BLITZGS_CHECK(gradients.size(0) >= splats.n_splats, op, "gradients must have ", splats.n_splats,
                " splats or more, got ", gradients.size(0));
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_bwd(
    const std::vector<Tensor>& splats_in, const std::optional<Tensor>& backgrounds,
    const std::vector<Tensor>& lists, const std::vector<Tensor>& composited_in, const Tensor& v_renders,
    const std::optional<Tensor>& v_alphas, std::int64_t n_cameras, std::int64_t width, std::int64_t height,
    std::int64_t tile_size, std::int64_t tile_begin, std::int64_t tile_end, bool absgrad, bool deterministic,
    std::optional<Tensor> gradients) {
  constexpr const char* kOp = "rasterize_bwd";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats = backward_splats(kOp, splats_in, backgrounds, lists, grid);
  if (gradients) check_gradients(kOp, splats, *gradients);
  BLITZGS_CHECK(!gradients || !v_alphas, kOp, "v_alphas needs gradients in columns");
  const Composited composited(kOp, splats, composited_in, v_renders, v_alphas);
  const std::int64_t n_splats = gradients ? 0 : splats.n_splats;
  Tensor v_means2d = make_empty(splats.means2d, {n_splats, 2});
  Tensor v_conics = make_empty(splats.means2d, {n_splats, 3});
  Tensor v_opacities = make_empty(splats.means2d, {n_splats});
  Tensor v_colors = make_empty(splats.means2d, {n_splats, splats.n_channels});
  Tensor v_means2d_abs = make_empty(splats.means2d, {absgrad ? n_splats : 0, 2});
  DeviceScope scope(splats.means2d);
#ifdef BLITZGS_BACKEND_CUDA
  if (gradients) {
    cuda::rasterize_bwd_packed(splats.input<float>(), composited.saved<float>(), splats.isect_splats.size(0),
                               composited.aux(), deterministic, absgrad, mutable_data<float>(*gradients),
                               scope.workspace, scope.stream);
    return {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs};
  }
#endif
  dispatch_floating(splats.means2d, [&]<class T>() {
    const RasterizeGradients<T> columns{mutable_data<T>(v_means2d), mutable_data<T>(v_conics),
                                        mutable_data<T>(v_opacities), mutable_data<T>(v_colors),
                                        absgrad ? mutable_data<T>(v_means2d_abs) : nullptr};
    backend::rasterize_bwd(splats.input<T>(), composited.saved<T>(), splats.isect_splats.size(0),
                           composited.aux(), deterministic, columns, scope.workspace, scope.stream);
  });
  return {v_means2d, v_conics, v_opacities, v_colors, v_means2d_abs};
}

#ifdef BLITZGS_BACKEND_CUDA
CompositedTensors rasterize_fwd_into(const Tensor& means2d, const Tensor& conics,
                                     const Tensor& splat_opacities, const Tensor& colors,
                                     const std::optional<Tensor>& backgrounds, const Tensor& isect_splats,
                                     const Tensor& tile_offsets, std::int64_t n_cameras, std::int64_t width,
                                     std::int64_t height, std::int64_t tile_size, std::int64_t tile_begin,
                                     std::int64_t tile_end, Tensor gradients,
                                     const std::optional<Tensor>& known_splats) {
  constexpr const char* kOp = "rasterize_fwd_";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const Splats splats(kOp, means2d, conics, splat_opacities, colors, backgrounds, isect_splats, tile_offsets,
                      grid, known_splats);
  check_gradients(kOp, splats, gradients);
  return composite(splats, gradients, false);
}
#endif

constexpr const char* kPixelSplats = "pixel_splats";

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> pixel_splats(
    const Tensor& means2d, const Tensor& conics, const Tensor& opacities, const Tensor& isect_splats,
    const Tensor& tile_offsets, const std::optional<Tensor>& slots_in, std::int64_t n_rows,
    std::int64_t n_cameras, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t strongest) {
  const TileGrid grid = checked_tile_grid(kPixelSplats, n_cameras, width, height, tile_size, 0, -1);
  const ListedSplats splats(kPixelSplats, means2d, conics, opacities, isect_splats, tile_offsets, grid);
  const std::int64_t pixels = n_cameras * width * height;
  const std::optional<Tensor> slots =
      checked(kPixelSplats, "slots", slots_in, ScalarType::Int, {n_cameras, height, width});
  BLITZGS_CHECK(strongest >= 0 && strongest < (1 << 24), kPixelSplats,
                "strongest must be 0 to 2^24 - 1, got ", strongest);
  BLITZGS_CHECK(slots ? n_rows >= 0 : n_rows == pixels, kPixelSplats,
                "n_rows must be the number of rows that slots name, and without slots the number of "
                "pixels, got ",
                n_rows);
  Tensor transmittances = make_empty(means2d, {n_rows}),
         counts = make_empty(means2d, {n_rows}, ScalarType::Int),
         medians = make_empty(means2d, {n_rows}, ScalarType::Int),
         ids = make_empty(means2d, {n_rows, strongest}, ScalarType::Int),
         weights = make_empty(means2d, {n_rows, strongest});
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&]<class T>() {
    const PixelSplats<T> out{data_or_null<std::int32_t>(slots),  n_rows,
                             static_cast<int>(strongest),        mutable_data<T>(transmittances),
                             mutable_data<std::int32_t>(counts), mutable_data<std::int32_t>(medians),
                             mutable_data<std::int32_t>(ids),    mutable_data<T>(weights)};
    backend::pixel_splats(splats.input<T>(), out, scope.workspace, scope.stream);
  });
  return {transmittances, counts, medians, ids, weights};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("rasterize_fwd", TORCH_BOX(&blitzgs::rasterize_fwd));
  m.impl("rasterize_bwd", TORCH_BOX(&blitzgs::rasterize_bwd));
  m.impl("pixel_splats", TORCH_BOX(&blitzgs::pixel_splats));
#ifdef BLITZGS_BACKEND_CUDA
  m.impl("rasterize_fwd_", TORCH_BOX(&blitzgs::rasterize_fwd_into));
#endif
}
