// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <algorithm>
#include <limits>
#include <tuple>

#include "common/rows.h"
#include "importance/mass_cut.h"
#include "rasterize/rasterize_op.h"

namespace blitzgs {
namespace {

constexpr const char* kContributions = "contributions";

std::tuple<Tensor, Tensor, Tensor> contributions(const Tensor& means2d, const Tensor& conics,
                                                 const Tensor& opacities, const Tensor& isect_splats,
                                                 const Tensor& tile_offsets, std::int64_t n_cameras,
                                                 std::int64_t width, std::int64_t height,
                                                 std::int64_t tile_size, std::int64_t tile_begin,
                                                 std::int64_t tile_end, const std::optional<Tensor>& n_splats,
                                                 bool with_squares) {
  const TileGrid grid =
      checked_tile_grid(kContributions, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const ListedSplats splats(kContributions, means2d, conics, opacities, isect_splats, tile_offsets, grid,
                            n_splats);
  Tensor weights = make_empty(means2d, {splats.n_splats}, ScalarType::Long);
  Tensor pixels = make_empty(means2d, {splats.n_splats}, ScalarType::Int);
  Tensor squares = make_empty(means2d, {with_squares ? splats.n_splats : 0}, ScalarType::Long);
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&]<class T>() {
    const RasterizeInput<T> in = splats.input<T>();
    const ContributionSums sums{mutable_data<std::int64_t>(weights), mutable_data<std::int32_t>(pixels),
                                with_squares ? mutable_data<std::int64_t>(squares) : nullptr};
    backend::contributions(ContributionInput<T>{in.means2d, in.conics, in.opacities, in.isect_splats,
                                                in.tile_offsets, in.n_splats, in.grid, in.known_splats},
                           sums, scope.workspace, scope.stream);
  });
  return {weights, pixels, squares};
}

constexpr const char* kMassCut = "mass_cut_";

void mass_cut_(const Tensor& weights, const Tensor& segments, const Tensor& owners, const Tensor& ids,
               Tensor searches, Tensor sums, Tensor listed, Tensor chosen, std::int64_t numerator,
               std::int64_t denominator, std::int64_t first_step, std::int64_t last_step) {
  const std::int64_t items = weights.numel(), n_segments = searches.size(0);
  BLITZGS_CHECK(items < std::numeric_limits<std::int32_t>::max(), kMassCut,
                "items are counted in 32 bits, got ", items, "; cut fewer segments at once");
  BLITZGS_CHECK(n_segments > 0, kMassCut, "there must be segments");
  BLITZGS_CHECK(0 <= numerator && numerator <= denominator && 0 < denominator && denominator <= 1'000'000'000,
                kMassCut, "the share must be in [0, 1] with at most 9 decimals, got ", numerator, " / ",
                denominator);
  BLITZGS_CHECK(0 <= first_step && first_step <= last_step && last_step <= kSteps, kMassCut,
                "steps must be in [0, ", kSteps, "], got ", first_step, " to ", last_step);
  check_in_place(kMassCut, "weights", weights, ScalarType::Long, {-1});
  check_in_place(kMassCut, "segments", segments, ScalarType::Int, {items});
  check_in_place(kMassCut, "owners", owners, ScalarType::Int, {items});
  check_in_place(kMassCut, "ids", ids, ScalarType::Long, {-1});
  check_in_place(kMassCut, "searches", searches, ScalarType::Long, {n_segments, sizeof(SegmentSearch) / 8});
  check_in_place(kMassCut, "sums", sums, ScalarType::Long, {n_segments, kDigits});
  check_in_place(kMassCut, "listed", listed, ScalarType::Int, {items + 1});
  check_in_place(kMassCut, "chosen", chosen, ScalarType::Bool, {items});
  DeviceScope scope(weights);
  const MassCutArgs args{data<std::int64_t>(weights),
                         data<std::int32_t>(segments),
                         data<std::int32_t>(owners),
                         data<std::int64_t>(ids),
                         items,
                         n_segments,
                         numerator,
                         denominator,
                         reinterpret_cast<SegmentSearch*>(mutable_data<std::int64_t>(searches)),
                         mutable_data<std::int64_t>(sums),
                         mutable_data<std::int32_t>(listed),
                         mutable_data<bool>(chosen)};
  backend::mass_cut(args, static_cast<int>(first_step), static_cast<int>(last_step), scope.stream);
}

constexpr const char* kViewSums = "view_sums_";

// sums: score, seen, counted, cull. splats: visible_ids, splat_offsets, camera_ids, radii.
void view_sums_(const std::vector<Tensor>& sums, const std::vector<Tensor>& splats, const Tensor& weights,
                const Tensor& pixels, const Tensor& counts, const std::vector<std::int64_t>& columns,
                std::int64_t rule, double eps, double unit) {
  BLITZGS_CHECK(sums.size() == 4 && splats.size() == 4, kViewSums,
                "sums are score, seen, counted, cull; splats are visible_ids, splat_offsets, camera_ids, "
                "radii; got ",
                sums.size(), " and ", splats.size(), " tensors");
  const std::int64_t n = sums[0].numel(), words = sums[3].dim() == 2 ? sums[3].size(1) : 0;
  const std::int64_t visible = splats[0].numel(), count = weights.numel();
  check_in_place(kViewSums, "score", sums[0], ScalarType::Long, {n});
  check_in_place(kViewSums, "seen", sums[1], ScalarType::Int, {n});
  check_in_place(kViewSums, "counted", sums[2], ScalarType::Int, {n});
  check_in_place(kViewSums, "cull", sums[3], ScalarType::Int, {n, words});
  check_in_place(kViewSums, "visible_ids", splats[0], ScalarType::Int, {visible});
  check_in_place(kViewSums, "splat_offsets", splats[1], ScalarType::Int, {visible + 1});
  check_in_place(kViewSums, "camera_ids", splats[2], ScalarType::Int, {count});
  check_in_place(kViewSums, "radii", splats[3], ScalarType::Int, {count, 2});
  check_in_place(kViewSums, "weights", weights, ScalarType::Long, {count});
  check_in_place(kViewSums, "pixels", pixels, ScalarType::Int, {count});
  check_in_place(kViewSums, "counts", counts, ScalarType::Bool, {count});
  BLITZGS_CHECK(!columns.empty() && columns.size() <= kMaxViews, kViewSums, "1 to ", kMaxViews,
                " views at once, got ", columns.size());
  for (const std::int64_t column : columns) {
    BLITZGS_CHECK(0 <= column && column < 32 * words, kViewSums, "cull has ", 32 * words, " columns, got ",
                  column);
  }
  BLITZGS_CHECK(0 <= rule && rule <= 2, kViewSums, "rule must be 0, 1 or 2, got ", rule);
  DeviceScope scope(weights);
  ViewSums args{data<std::int64_t>(weights),
                data<std::int32_t>(pixels),
                data<std::int32_t>(splats[3]),
                data<std::int32_t>(splats[2]),
                data<bool>(counts),
                data<std::int32_t>(splats[0]),
                data<std::int32_t>(splats[1]),
                visible,
                words,
                static_cast<std::int64_t*>(sums[0].mutable_data_ptr()),
                static_cast<std::int32_t*>(sums[1].mutable_data_ptr()),
                static_cast<std::int32_t*>(sums[2].mutable_data_ptr()),
                static_cast<std::uint32_t*>(sums[3].mutable_data_ptr()),
                static_cast<ScoreRule>(rule),
                eps,
                unit,
                {}};
  std::transform(columns.begin(), columns.end(), args.columns,
                 [](std::int64_t column) { return static_cast<std::int32_t>(column); });
  backend::for_each_row(args, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("contributions", TORCH_BOX(&blitzgs::contributions));
  m.impl("mass_cut_", TORCH_BOX(&blitzgs::mass_cut_));
  m.impl("view_sums_", TORCH_BOX(&blitzgs::view_sums_));
}
