// SPDX-License-Identifier: Apache-2.0
#include "importance/view_sums.h"

#include <algorithm>

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "view_sums_";

// sums: score, seen, counted, cull. splats: visible_ids, splat_offsets, camera_ids, radii.
void view_sums_(const std::vector<Tensor>& sums, const std::vector<Tensor>& splats, const Tensor& weights,
                const Tensor& pixels, const Tensor& counts, const std::vector<std::int64_t>& columns,
                std::int64_t rule, double eps, double unit) {
  STD_TORCH_CHECK(sums.size() == 4 && splats.size() == 4, "blitzgs::", kOp,
                  ": sums are score, seen, counted, cull; splats are visible_ids, splat_offsets, camera_ids, "
                  "radii; got ",
                  sums.size(), " and ", splats.size(), " tensors");
  const std::int64_t n = sums[0].numel(), words = sums[3].dim() == 2 ? sums[3].size(1) : 0;
  const std::int64_t visible = splats[0].numel(), count = weights.numel();
  check_in_place(kOp, "score", sums[0], ScalarType::Long, {n});
  check_in_place(kOp, "seen", sums[1], ScalarType::Int, {n});
  check_in_place(kOp, "counted", sums[2], ScalarType::Int, {n});
  check_in_place(kOp, "cull", sums[3], ScalarType::Int, {n, words});
  check_in_place(kOp, "visible_ids", splats[0], ScalarType::Int, {visible});
  check_in_place(kOp, "splat_offsets", splats[1], ScalarType::Int, {visible + 1});
  check_in_place(kOp, "camera_ids", splats[2], ScalarType::Int, {count});
  check_in_place(kOp, "radii", splats[3], ScalarType::Int, {count, 2});
  check_in_place(kOp, "weights", weights, ScalarType::Long, {count});
  check_in_place(kOp, "pixels", pixels, ScalarType::Int, {count});
  check_in_place(kOp, "counts", counts, ScalarType::Bool, {count});
  STD_TORCH_CHECK(!columns.empty() && columns.size() <= kMaxViews, "blitzgs::", kOp, ": 1 to ", kMaxViews,
                  " views at once, got ", columns.size());
  for (const std::int64_t column : columns) {
    STD_TORCH_CHECK(0 <= column && column < 32 * words, "blitzgs::", kOp, ": cull has ", 32 * words,
                    " columns, got ", column);
  }
  STD_TORCH_CHECK(0 <= rule && rule <= 2, "blitzgs::", kOp, ": rule must be 0, 1 or 2, got ", rule);
  DeviceScope scope(weights);
  ViewSumsArgs args{data<std::int64_t>(weights),
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
  backend::view_sums(args, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("view_sums_", TORCH_BOX(&blitzgs::view_sums_)); }
