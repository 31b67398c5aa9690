// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <limits>
#include <tuple>

#include "common/op.h"
#include "common/row_count_op.h"
#include "common/tile_grid_op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "contributions";

std::tuple<Tensor, Tensor> contributions(const Tensor& means2d_in, const Tensor& conics_in,
                                         const Tensor& opacities_in, const Tensor& isect_rows_in,
                                         const Tensor& tile_offsets_in,
                                         const std::vector<std::int64_t>& grid_numbers,
                                         const std::optional<Tensor>& n_rows) {
  const TileGrid grid = checked_tile_grid(kOp, grid_numbers);
  const std::int64_t rows = means2d_in.size(0);
  check_floating(kOp, "means2d", means2d_in);
  check_shape(kOp, "means2d", means2d_in, {rows, 2});
  check_shape(kOp, "conics", conics_in, {rows, 3});
  check_shape(kOp, "row_opacities", opacities_in, {rows});
  check_dtype(kOp, "conics", conics_in, means2d_in.scalar_type());
  check_dtype(kOp, "row_opacities", opacities_in, means2d_in.scalar_type());
  check_shape(kOp, "isect_rows", isect_rows_in, {-1});
  check_dtype(kOp, "isect_rows", isect_rows_in, ScalarType::Int);
  check_shape(kOp, "tile_offsets", tile_offsets_in, {grid.count() + 1});
  check_dtype(kOp, "tile_offsets", tile_offsets_in, ScalarType::Long);
  STD_TORCH_CHECK(rows <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", kOp,
                  ": row indices are 32-bit, got ", rows, " rows; survey fewer views at once");
  const RowCount row_count = checked_row_count(kOp, n_rows, means2d_in);
  const Tensor means2d = as_contiguous(means2d_in), conics = as_contiguous(conics_in);
  const Tensor opacities = as_contiguous(opacities_in), isect_rows = as_contiguous(isect_rows_in);
  const Tensor tile_offsets = as_contiguous(tile_offsets_in);
  Tensor weights = make_empty(means2d, {rows}, ScalarType::Long);
  Tensor pixels = make_empty(means2d, {rows}, ScalarType::Int);
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&](auto zero) {
    using T = decltype(zero);
    const ContributionInput<T> in{data<T>(means2d),
                                  data<T>(conics),
                                  data<T>(opacities),
                                  data<std::int32_t>(isect_rows),
                                  data<std::int64_t>(tile_offsets),
                                  row_count.n_rows,
                                  grid,
                                  row_count.known_rows};
    const ContributionSums sums{mutable_data<std::int64_t>(weights), mutable_data<std::int32_t>(pixels)};
    backend::contributions(in, sums, scope.workspace, scope.stream);
  });
  return {weights, pixels};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("contributions", TORCH_BOX(&blitzgs::contributions)); }
