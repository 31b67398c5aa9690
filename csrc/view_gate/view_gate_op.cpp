// SPDX-License-Identifier: Apache-2.0
#include "view_gate/view_gate.h"

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "gate_views_";

void set_reach(const std::vector<double>& reach, ViewGateArgs& args) {
  STD_TORCH_CHECK(!reach.empty() && reach.size() <= kMaxLevels, "blitzgs::", kOp, ": 1 to ", kMaxLevels,
                  " levels are supported, got ", reach.size());
  args.n_levels = static_cast<int>(reach.size());
  for (int level = 0; level < args.n_levels; ++level) {
    args.table.reach2[level] = reach[level] < 0 ? -1.0f : static_cast<float>(reach[level] * reach[level]);
  }
}

void set_columns(const std::vector<std::int64_t>& columns, const std::optional<Tensor>& cull,
                 ViewGateArgs& args) {
  if (columns.empty()) return;
  STD_TORCH_CHECK(static_cast<int>(columns.size()) == args.n_views, "blitzgs::", kOp, ": ", args.n_views,
                  " views need as many columns of the cull matrix, got ", columns.size());
  STD_TORCH_CHECK(cull.has_value(), "blitzgs::", kOp, ": columns need a cull matrix");
  for (int view = 0; view < args.n_views; ++view) {
    STD_TORCH_CHECK(columns[view] < 32 * args.words, "blitzgs::", kOp, ": the cull matrix has ",
                    32 * args.words, " columns, got column ", columns[view]);
    args.table.columns[view] = static_cast<std::int32_t>(columns[view]);
    if (columns[view] >= 0) args.cull_views |= 1u << view;
  }
}

void gate_views_(const Tensor& ids_in, Tensor views, const std::optional<Tensor>& count,
                 const Tensor& means_in, const Tensor& level_in, const Tensor& viewmats_in,
                 std::vector<double> reach, std::int64_t lod_views, const std::optional<Tensor>& cull_in,
                 std::vector<std::int64_t> columns) {
  check_dtype(kOp, "ids", ids_in, ScalarType::Int);
  check_shape(kOp, "ids", ids_in, {-1});
  const std::int64_t room = ids_in.size(0);
  check_dtype(kOp, "views", views, ScalarType::Int);
  check_shape(kOp, "views", views, {room});
  STD_TORCH_CHECK(views.is_contiguous(), "blitzgs::", kOp,
                  ": views is updated in place and must be contiguous");
  check_dtype(kOp, "means", means_in, ScalarType::Float);
  check_shape(kOp, "means", means_in, {-1, 3});
  const std::int64_t rows = means_in.size(0);
  check_dtype(kOp, "level", level_in, ScalarType::Byte);
  check_shape(kOp, "level", level_in, {rows});
  check_dtype(kOp, "viewmats", viewmats_in, ScalarType::Float);
  check_shape(kOp, "viewmats", viewmats_in, {-1, 4, 4});
  STD_TORCH_CHECK(viewmats_in.size(0) <= kMaxViews, "blitzgs::", kOp, ": at most ", kMaxViews,
                  " views at once, got ", viewmats_in.size(0));
  const Tensor ids = as_contiguous(ids_in), means = as_contiguous(means_in), level = as_contiguous(level_in);
  const Tensor viewmats = as_contiguous(viewmats_in);
  std::optional<Tensor> cull;
  if (cull_in) {
    check_dtype(kOp, "cull", *cull_in, ScalarType::Int);
    check_shape(kOp, "cull", *cull_in, {rows, -1});
    cull = as_contiguous(*cull_in);
  }
  ViewGateArgs args{};
  args.ids = data<std::int32_t>(ids);
  args.views = mutable_data<std::int32_t>(views);
  args.room = most_listed(kOp, count, room);
  args.count = data_or_null<std::int32_t>(count);
  args.means = data<float>(means);
  args.level = data<std::uint8_t>(level);
  args.viewmats = data<float>(viewmats);
  args.cull = data_or_null<std::int32_t>(cull);
  args.words = cull ? cull->size(1) : 0;
  args.n_views = static_cast<int>(viewmats.size(0));
  args.lod_views = static_cast<std::uint32_t>(lod_views);
  set_reach(reach, args);
  set_columns(columns, cull, args);
  if (args.lod_views == 0 && args.cull_views == 0) return;
  DeviceScope scope(views);
  backend::gate_views(args, scope.workspace, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("gate_views_", TORCH_BOX(&blitzgs::gate_views_)); }
