// SPDX-License-Identifier: Apache-2.0
#include "importance/mass_cut.h"

#include <limits>

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "mass_cut_";

void mass_cut_(const Tensor& weights, const Tensor& segments, const Tensor& owners, const Tensor& ids,
               Tensor searches, Tensor sums, Tensor listed, Tensor chosen, std::int64_t numerator,
               std::int64_t denominator, std::int64_t first_step, std::int64_t last_step) {
  const std::int64_t items = weights.numel(), n_segments = searches.size(0);
  STD_TORCH_CHECK(items < std::numeric_limits<std::int32_t>::max(), "blitzgs::", kOp,
                  ": items are counted in 32 bits, got ", items, "; cut fewer segments at once");
  STD_TORCH_CHECK(n_segments > 0, "blitzgs::", kOp, ": there must be segments");
  STD_TORCH_CHECK(
      0 <= numerator && numerator <= denominator && 0 < denominator && denominator <= 1'000'000'000,
      "blitzgs::", kOp, ": the share must be in [0, 1] with at most 9 decimals, got ", numerator, " / ",
      denominator);
  STD_TORCH_CHECK(0 <= first_step && first_step <= last_step && last_step <= kSteps, "blitzgs::", kOp,
                  ": steps must be in [0, ", kSteps, "], got ", first_step, " to ", last_step);
  check_in_place(kOp, "weights", weights, ScalarType::Long, {-1});
  check_in_place(kOp, "segments", segments, ScalarType::Int, {items});
  check_in_place(kOp, "owners", owners, ScalarType::Int, {items});
  check_in_place(kOp, "ids", ids, ScalarType::Long, {-1});
  check_in_place(kOp, "searches", searches, ScalarType::Long, {n_segments, sizeof(SegmentSearch) / 8});
  check_in_place(kOp, "sums", sums, ScalarType::Long, {n_segments, kDigits});
  check_in_place(kOp, "listed", listed, ScalarType::Int, {items + 1});
  check_in_place(kOp, "chosen", chosen, ScalarType::Bool, {items});
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

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("mass_cut_", TORCH_BOX(&blitzgs::mass_cut_)); }
