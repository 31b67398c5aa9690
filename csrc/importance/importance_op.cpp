// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <tuple>

#include "common/rows.h"
#include "importance/mass_cut.h"
#include "rasterize/rasterize_op.h"

namespace blitzgs {
namespace {

std::tuple<Tensor, Tensor, Tensor> contributions(const Tensor& means2d, const Tensor& conics,
                                                 const Tensor& opacities, const Tensor& isect_splats,
                                                 const Tensor& tile_offsets, std::int64_t n_cameras,
                                                 std::int64_t width, std::int64_t height,
                                                 std::int64_t tile_size, std::int64_t tile_begin,
                                                 std::int64_t tile_end, const std::optional<Tensor>& n_splats,
                                                 bool with_squares) {
  constexpr const char* kOp = "contributions";
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  const ListedSplats splats(kOp, means2d, conics, opacities, isect_splats, tile_offsets, grid, n_splats);
  const auto weights = make<std::int64_t>(means2d, {splats.n_splats}),
             squares = make<std::int64_t>(means2d, {with_squares ? splats.n_splats : 0});
  const auto pixels = make<std::int32_t>(means2d, {splats.n_splats});
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&]<class T>() {
    backend::contributions(splats.input<T>(), {weights, pixels, squares.data_if(with_squares)},
                           scope.workspace, scope.stream);
  });
  return {weights, pixels, squares};
}

void mass_cut_(const Tensor& weights, const Tensor& segments, const Tensor& owners, const Tensor& ids,
               const Tensor& searches, const Tensor& sums, const Tensor& listed, const Tensor& chosen,
               std::int64_t numerator, std::int64_t denominator, std::int64_t first_step,
               std::int64_t last_step) {
  constexpr const char* kOp = "mass_cut_";
  const std::int64_t items = weights.numel(), n_segments = searches.size(0);
  BLITZGS_CHECK(items < std::numeric_limits<std::int32_t>::max(), kOp, "items are counted in 32 bits, got ",
                items, "; cut fewer segments at once");
  BLITZGS_CHECK(n_segments > 0, kOp, "there must be segments");
  BLITZGS_CHECK(0 <= numerator && numerator <= denominator && 0 < denominator && denominator <= 1'000'000'000,
                kOp, "the share must be in [0, 1] with at most 9 decimals, got ", numerator, " / ",
                denominator);
  BLITZGS_CHECK(0 <= first_step && first_step <= last_step && last_step <= kSteps, kOp,
                "steps must be in [0, ", kSteps, "], got ", first_step, " to ", last_step);
  std::int64_t* found =
      checked_in_place<std::int64_t>(kOp, "searches", searches, {n_segments, sizeof(SegmentSearch) / 8});
  const MassCutArgs args{checked_in_place<std::int64_t>(kOp, "weights", weights, {-1}),
                         checked_in_place<std::int32_t>(kOp, "segments", segments, {items}),
                         checked_in_place<std::int32_t>(kOp, "owners", owners, {items}),
                         checked_in_place<std::int64_t>(kOp, "ids", ids, {-1}),
                         items,
                         n_segments,
                         numerator,
                         denominator,
                         reinterpret_cast<SegmentSearch*>(found),
                         checked_in_place<std::int64_t>(kOp, "sums", sums, {n_segments, kDigits}),
                         checked_in_place<std::int32_t>(kOp, "listed", listed, {items + 1}),
                         checked_in_place<bool>(kOp, "chosen", chosen, {items})};
  DeviceScope scope(weights);
  backend::mass_cut(args, static_cast<int>(first_step), static_cast<int>(last_step), scope.stream);
}

// sums: score, seen, counted, cull. splats: visible_ids, splat_offsets, camera_ids, radii.
void view_sums_(const std::vector<Tensor>& sums, const std::vector<Tensor>& splats, const Tensor& weights,
                const Tensor& pixels, const Tensor& counts, const std::vector<std::int64_t>& columns,
                std::int64_t rule, double eps, double unit) {
  constexpr const char* kOp = "view_sums_";
  BLITZGS_CHECK(sums.size() == 4 && splats.size() == 4, kOp,
                "sums are score, seen, counted, cull; splats are visible_ids, splat_offsets, camera_ids, "
                "radii; got ",
                sums.size(), " and ", splats.size(), " tensors");
  const std::int64_t n = sums[0].numel(), words = sums[3].dim() == 2 ? sums[3].size(1) : 0;
  const std::int64_t visible = splats[0].numel(), count = weights.numel();
  BLITZGS_CHECK(!columns.empty() && columns.size() <= kMaxViews, kOp, "1 to ", kMaxViews,
                " views at once, got ", columns.size());
  BLITZGS_CHECK(0 <= rule && rule <= 2, kOp, "rule must be 0, 1 or 2, got ", rule);
  std::int32_t* cull = checked_in_place<std::int32_t>(kOp, "cull", sums[3], {n, words});
  ViewSums args{checked_in_place<std::int64_t>(kOp, "weights", weights, {count}),
                checked_in_place<std::int32_t>(kOp, "pixels", pixels, {count}),
                checked_in_place<std::int32_t>(kOp, "radii", splats[3], {count, 2}),
                checked_in_place<std::int32_t>(kOp, "camera_ids", splats[2], {count}),
                checked_in_place<bool>(kOp, "counts", counts, {count}),
                checked_in_place<std::int32_t>(kOp, "visible_ids", splats[0], {visible}),
                checked_in_place<std::int32_t>(kOp, "splat_offsets", splats[1], {visible + 1}),
                visible,
                words,
                checked_in_place<std::int64_t>(kOp, "score", sums[0], {n}),
                checked_in_place<std::int32_t>(kOp, "seen", sums[1], {n}),
                checked_in_place<std::int32_t>(kOp, "counted", sums[2], {n}),
                reinterpret_cast<std::uint32_t*>(cull),
                static_cast<ScoreRule>(rule),
                eps,
                unit,
                {}};
  for (std::size_t view = 0; view < columns.size(); ++view) {
    BLITZGS_CHECK(0 <= columns[view] && columns[view] < 32 * words, kOp, "cull has ", 32 * words,
                  " columns, got ", columns[view]);
    args.columns[view] = static_cast<std::int32_t>(columns[view]);
  }
  DeviceScope scope(weights);
  backend::for_each_row(args, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("contributions", TORCH_BOX(&blitzgs::contributions));
  m.impl("mass_cut_", TORCH_BOX(&blitzgs::mass_cut_));
  m.impl("view_sums_", TORCH_BOX(&blitzgs::view_sums_));
}
