// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <tuple>

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "contributions";

std::tuple<Tensor, Tensor, Tensor> contributions(const Tensor& means2d_in, const Tensor& conics_in,
                                                 const Tensor& opacities_in, const Tensor& isect_splats_in,
                                                 const Tensor& tile_offsets_in, std::int64_t n_cameras,
                                                 std::int64_t width, std::int64_t height,
                                                 std::int64_t tile_size, std::int64_t tile_begin,
                                                 std::int64_t tile_end, const std::optional<Tensor>& n_splats,
                                                 bool with_squares) {
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const std::int64_t splats = means2d_in.size(0);
  check_floating(kOp, "means2d", means2d_in);
  const ScalarType dtype = means2d_in.scalar_type();
  const Tensor means2d = checked(kOp, "means2d", means2d_in, dtype, {splats, 2}),
               conics = checked(kOp, "conics", conics_in, dtype, {splats, 3}),
               opacities = checked(kOp, "splat_opacities", opacities_in, dtype, {splats}),
               isect_splats = checked(kOp, "isect_splats", isect_splats_in, ScalarType::Int, {-1}),
               tile_offsets =
                   checked(kOp, "tile_offsets", tile_offsets_in, ScalarType::Long, {grid.count() + 1});
  const SplatCount splat_count = checked_splat_count(kOp, n_splats, means2d);
  Tensor weights = make_empty(means2d, {splats}, ScalarType::Long);
  Tensor pixels = make_empty(means2d, {splats}, ScalarType::Int);
  Tensor squares = make_empty(means2d, {with_squares ? splats : 0}, ScalarType::Long);
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&](auto zero) {
    using T = decltype(zero);
    const ContributionInput<T> in{data<T>(means2d),
                                  data<T>(conics),
                                  data<T>(opacities),
                                  data<std::int32_t>(isect_splats),
                                  data<std::int64_t>(tile_offsets),
                                  splat_count.n_splats,
                                  grid,
                                  splat_count.known_splats};
    const ContributionSums sums{mutable_data<std::int64_t>(weights), mutable_data<std::int32_t>(pixels),
                                with_squares ? mutable_data<std::int64_t>(squares) : nullptr};
    backend::contributions(in, sums, scope.workspace, scope.stream);
  });
  return {weights, pixels, squares};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("contributions", TORCH_BOX(&blitzgs::contributions)); }
