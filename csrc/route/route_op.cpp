// SPDX-License-Identifier: Apache-2.0
#include "route/route.h"

#include <limits>
#include <tuple>

#include "common/op.h"

namespace blitzgs {
namespace {

std::tuple<Tensor, Tensor> route_count(const Tensor& means2d, const Tensor& conics, const Tensor& opacities,
                                       const Tensor& camera_ids, const std::vector<std::int64_t>& tile_begins,
                                       const std::vector<std::int64_t>& tile_ends, std::int64_t width,
                                       std::int64_t height, std::int64_t tile_size) {
  constexpr const char* kOp = "route_count";
  check_floating(kOp, "means2d", means2d);
  check_shape(kOp, "means2d", means2d, {-1, 2});
  const std::int64_t n = means2d.size(0);
  check_shape(kOp, "conics", conics, {n, 3});
  check_shape(kOp, "row_opacities", opacities, {n});
  check_shape(kOp, "camera_ids", camera_ids, {n});
  check_dtype(kOp, "conics", conics, means2d.scalar_type());
  check_dtype(kOp, "row_opacities", opacities, means2d.scalar_type());
  check_dtype(kOp, "camera_ids", camera_ids, ScalarType::Int);
  STD_TORCH_CHECK(width > 0 && height > 0 && tile_size > 0,
                  "blitzgs::route_count: width, height and tile_size must be positive, got ", width, ", ",
                  height, ", ", tile_size);
  STD_TORCH_CHECK(n <= std::numeric_limits<std::int32_t>::max(), "blitzgs::route_count: ", n,
                  " rows exceed 2^31 - 1; project fewer views at a time");
  const std::int64_t n_ranks = static_cast<std::int64_t>(tile_begins.size());
  STD_TORCH_CHECK(n_ranks >= 1 && n_ranks <= kMaxRanks, "blitzgs::route_count: 1 to ", kMaxRanks,
                  " ranks are supported, got ", n_ranks);
  STD_TORCH_CHECK(tile_ends.size() == tile_begins.size(), "blitzgs::route_count: ", n_ranks,
                  " tile_begins and ", tile_ends.size(), " tile_ends");
  RankTiles ranks{};
  ranks.n_ranks = static_cast<int>(n_ranks);
  for (std::int64_t m = 0; m < n_ranks; ++m) {
    STD_TORCH_CHECK(tile_begins[m] >= (m ? tile_begins[m - 1] : 0) && tile_ends[m] >= tile_begins[m],
                    "blitzgs::route_count: tile ranges must begin in ascending order from 0 and not end "
                    "before they begin, got [",
                    tile_begins[m], ", ", tile_ends[m], ") for rank ", m);
    ranks.begin[m] = tile_begins[m];
    ranks.end[m] = tile_ends[m];
  }
  const Tensor means2d_c = as_contiguous(means2d), conics_c = as_contiguous(conics);
  const Tensor opacities_c = as_contiguous(opacities), cameras = as_contiguous(camera_ids);
  Tensor masks = make_empty(means2d_c, {n}, ScalarType::Long);
  Tensor counts = make_empty(means2d_c, {n_ranks, 2}, ScalarType::Long);
  DeviceScope scope(means2d_c);
  // The grid's own range is not used: the ranks have theirs.
  const TileGrid grid = make_tile_grid(1, static_cast<int>(width), static_cast<int>(height),
                                       static_cast<int>(tile_size), 0, -1);
  dispatch_floating(means2d_c, [&](auto zero) {
    using T = decltype(zero);
    const RouteInput<T> in{data<T>(means2d_c),
                           data<T>(conics_c),
                           data<T>(opacities_c),
                           data<std::int32_t>(cameras),
                           n,
                           grid,
                           ranks};
    backend::route_count(in, mutable_data<std::int64_t>(masks), mutable_data<std::int64_t>(counts),
                         scope.workspace, scope.stream);
  });
  return {masks, counts};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("route_count", TORCH_BOX(&blitzgs::route_count)); }
