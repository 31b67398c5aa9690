// SPDX-License-Identifier: Apache-2.0
#include "rasterize/pixel_splats.h"

#include <tuple>

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "pixel_splats";

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> pixel_splats(
    const Tensor& means2d_in, const Tensor& conics_in, const Tensor& opacities_in,
    const Tensor& isect_splats_in, const Tensor& tile_offsets_in, const std::optional<Tensor>& slots_in,
    std::int64_t n_rows, std::int64_t n_cameras, std::int64_t width, std::int64_t height,
    std::int64_t tile_size, std::int64_t strongest) {
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, 0, -1);
  const std::int64_t splats = means2d_in.size(0), pixels = n_cameras * width * height;
  check_floating(kOp, "means2d", means2d_in);
  const ScalarType dtype = means2d_in.scalar_type();
  const Tensor means2d = checked(kOp, "means2d", means2d_in, dtype, {splats, 2}),
               conics = checked(kOp, "conics", conics_in, dtype, {splats, 3}),
               opacities = checked(kOp, "splat_opacities", opacities_in, dtype, {splats}),
               isect_splats = checked(kOp, "isect_splats", isect_splats_in, ScalarType::Int, {-1}),
               tile_offsets =
                   checked(kOp, "tile_offsets", tile_offsets_in, ScalarType::Long, {grid.count() + 1});
  const std::optional<Tensor> slots =
      checked(kOp, "slots", slots_in, ScalarType::Int, {n_cameras, height, width});
  STD_TORCH_CHECK(strongest >= 0 && strongest < (1 << 24), "blitzgs::", kOp,
                  ": strongest must be 0 to 2^24 - 1, got ", strongest);
  STD_TORCH_CHECK(slots ? n_rows >= 0 : n_rows == pixels, "blitzgs::", kOp,
                  ": n_rows must be the number of rows that slots name, and without slots the number of "
                  "pixels, got ",
                  n_rows);
  Tensor transmittances = make_empty(means2d, {n_rows}),
         counts = make_empty(means2d, {n_rows}, ScalarType::Int),
         medians = make_empty(means2d, {n_rows}, ScalarType::Int),
         ids = make_empty(means2d, {n_rows, strongest}, ScalarType::Int),
         weights = make_empty(means2d, {n_rows, strongest});
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&](auto zero) {
    using T = decltype(zero);
    const RasterizeInput<T> in{data<T>(means2d),
                               data<T>(conics),
                               data<T>(opacities),
                               nullptr,
                               nullptr,
                               data<std::int32_t>(isect_splats),
                               data<std::int64_t>(tile_offsets),
                               splats,
                               0,
                               grid};
    const PixelSplats<T> out{data_or_null<std::int32_t>(slots),  n_rows,
                             static_cast<int>(strongest),        mutable_data<T>(transmittances),
                             mutable_data<std::int32_t>(counts), mutable_data<std::int32_t>(medians),
                             mutable_data<std::int32_t>(ids),    mutable_data<T>(weights)};
    backend::pixel_splats(in, out, scope.workspace, scope.stream);
  });
  return {transmittances, counts, medians, ids, weights};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("pixel_splats", TORCH_BOX(&blitzgs::pixel_splats)); }
