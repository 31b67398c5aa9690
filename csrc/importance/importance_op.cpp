// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include "importance/mass_cut.h"
#include "rasterize/rasterize_op.h"

namespace blitzgs {
namespace {

Tensors<3> contributions(const Tensor& means2d, const Tensor& conics, const Tensor& opacities,
                         const Tensor& isect_splats, const Tensor& tile_offsets, BLITZGS_TILES,
                         const OptionalTensor& n_splats, bool with_squares) {
  const TileGrid grid = checked_tile_grid(n_cameras, width, height, tile_size, tile_begin, tile_end);
  const ListedSplats splats(means2d, conics, opacities, isect_splats, tile_offsets, grid, n_splats);
  const auto weights = make<int64_t>(means2d, {splats.n_splats}),
             squares = make<int64_t>(means2d, {with_squares ? splats.n_splats : 0});
  const auto pixels = make<int32_t>(means2d, {splats.n_splats});
  DeviceScope scope(means2d);
  dispatch_floating(means2d, [&]<class T>() {
    backend::contributions(splats.input<T>(), {weights, pixels, squares.data_if(with_squares)},
                           scope.workspace, scope.stream);
  });
  return {weights, pixels, squares};
}

void mass_cut_(const Tensor& weights, const Tensor& segments, const Tensor& owners, const Tensor& ids,
               const Tensor& searches, const Tensor& sums, const Tensor& listed, const Tensor& chosen,
               int64_t numerator, int64_t denominator, int64_t first_step, int64_t last_step) {
  const int64_t items = weights.numel(), n_segments = searches.size(0);
  BLITZGS_CHECK(items < INT32_MAX, "items are counted in 32 bits, got ", items,
                "; cut fewer segments at once");
  BLITZGS_CHECK(n_segments > 0, "there must be segments");
  BLITZGS_CHECK(0 <= numerator && numerator <= denominator && 0 < denominator && denominator <= 1'000'000'000,
                "the share must be in [0, 1] with at most 9 decimals, got ", numerator, " / ", denominator);
  BLITZGS_CHECK(0 <= first_step && first_step <= last_step && last_step <= kSteps, "steps must be in [0, ",
                kSteps, "], got ", first_step, " to ", last_step);
  int64_t* found = checked_in_place<int64_t>("searches", searches, {n_segments, sizeof(SegmentSearch) / 8});
  const MassCutArgs args{checked_in_place<int64_t>("weights", weights, {-1}),
                         checked_in_place<int32_t>("segments", segments, {items}),
                         checked_in_place<int32_t>("owners", owners, {items}),
                         checked_in_place<int64_t>("ids", ids, {-1}),
                         items,
                         n_segments,
                         numerator,
                         denominator,
                         reinterpret_cast<SegmentSearch*>(found),
                         checked_in_place<int64_t>("sums", sums, {n_segments, kDigits}),
                         checked_in_place<int32_t>("listed", listed, {items + 1}),
                         checked_in_place<bool>("chosen", chosen, {items})};
  DeviceScope scope(weights);
  backend::mass_cut(args, int(first_step), int(last_step), scope.stream);
}

void view_sums_(const TensorList& sums, const TensorList& splats, const Tensor& weights, const Tensor& pixels,
                const Tensor& counts, const IntList& columns, int64_t rule, double eps, double unit) {
  check_group("sums (score, seen, counted, cull)", sums, 4, 4);
  check_group("splats (visible_ids, splat_offsets, camera_ids, radii)", splats, 4, 4);
  const int64_t n = sums[0].numel(), words = sums[3].dim() == 2 ? sums[3].size(1) : 0;
  const int64_t visible = splats[0].numel(), count = weights.numel();
  BLITZGS_CHECK(!columns.empty() && columns.size() <= kMaxViews, "1 to ", kMaxViews, " views at once, got ",
                columns.size());
  BLITZGS_CHECK(0 <= rule && rule <= 2, "rule must be 0, 1 or 2, got ", rule);
  int32_t* cull = checked_in_place<int32_t>("cull", sums[3], {n, words});
  ViewSums args{checked_in_place<int64_t>("weights", weights, {count}),
                checked_in_place<int32_t>("pixels", pixels, {count}),
                checked_in_place<int32_t>("radii", splats[3], {count, 2}),
                checked_in_place<int32_t>("camera_ids", splats[2], {count}),
                checked_in_place<bool>("counts", counts, {count}),
                checked_in_place<int32_t>("visible_ids", splats[0], {visible}),
                checked_in_place<int32_t>("splat_offsets", splats[1], {visible + 1}),
                visible,
                words,
                checked_in_place<int64_t>("score", sums[0], {n}),
                checked_in_place<int32_t>("seen", sums[1], {n}),
                checked_in_place<int32_t>("counted", sums[2], {n}),
                reinterpret_cast<uint32_t*>(cull),
                static_cast<ScoreRule>(rule),
                eps,
                unit,
                {}};
  for (size_t view = 0; view < columns.size(); ++view) {
    BLITZGS_CHECK(0 <= columns[view] && columns[view] < 32 * words, "cull has ", 32 * words, " columns, got ",
                  columns[view]);
    args.columns[view] = int32_t(columns[view]);
  }
  run_rows(weights, args);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "contributions", contributions);
  BLITZGS_OP(m, "mass_cut_", mass_cut_);
  BLITZGS_OP(m, "view_sums_", view_sums_);
}
