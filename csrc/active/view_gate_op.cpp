// SPDX-License-Identifier: Apache-2.0
#include "active/view_gate.h"

#include "active/view_gate_op.h"
#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "gate_views_";

void gate_views_(const Tensor& ids_in, Tensor views, const std::optional<Tensor>& count,
                 const Tensor& means_in, const Tensor& level_in, const Tensor& viewmats_in,
                 const std::vector<double>& reach, std::int64_t lod_views,
                 const std::optional<Tensor>& cull_in, const std::vector<std::int64_t>& columns) {
  const Tensor ids = checked(kOp, "ids", ids_in, ScalarType::Int, {-1});
  const std::int64_t capacity = ids.size(0);
  check_in_place(kOp, "views", views, ScalarType::Int, {capacity});
  const Tensor means = checked(kOp, "means", means_in, ScalarType::Float, {-1, 3});
  const Tensor viewmats = checked(kOp, "viewmats", viewmats_in, ScalarType::Float, {-1, 4, 4});
  STD_TORCH_CHECK(viewmats.size(0) <= kMaxViews, "blitzgs::", kOp, ": at most ", kMaxViews,
                  " views at once, got ", viewmats.size(0));
  const HeldRules held = hold_rules(kOp, means.size(0), static_cast<int>(viewmats.size(0)), level_in, reach,
                                    lod_views, cull_in, columns);
  if (!leaves_out_any(held.rules)) return;
  const ViewGateArgs args{data<std::int32_t>(ids),
                          mutable_data<std::int32_t>(views),
                          max_listed(kOp, count, capacity),
                          data_or_null<std::int32_t>(count),
                          data<float>(means),
                          data<float>(viewmats),
                          held.rules};
  DeviceScope scope(views);
  backend::gate_views(args, scope.workspace, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("gate_views_", TORCH_BOX(&blitzgs::gate_views_)); }
