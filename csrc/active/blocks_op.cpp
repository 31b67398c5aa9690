// SPDX-License-Identifier: Apache-2.0
#include "active/blocks.h"

#include <algorithm>
#include <tuple>

#include "active/view_gate_op.h"
#include "common/op.h"

namespace blitzgs {
namespace {

// The columns of the table, checked. `held` keeps the tensors alive during the call.
struct HeldRows {
  std::vector<Tensor> held;
  BlockRows rows{};
};

// rows: (means, scales), and if steps may be pending also the moments (exp_avg and exp_avg_sq of the means,
// then of the scales), last_step, moment_step and table. blitzgs/ops/blocks.py builds this group.
HeldRows hold_rows(const char* op, const std::vector<Tensor>& rows) {
  STD_TORCH_CHECK(rows.size() == 2 || rows.size() == 9, "blitzgs::", op,
                  ": rows must be (means, scales) or, with pending steps, (means, scales, exp_avg_means, "
                  "exp_avg_sq_means, exp_avg_scales, exp_avg_sq_scales, last_step, moment_step, table), got ",
                  rows.size(), " tensors");
  const std::int64_t n = rows[0].size(0);
  STD_TORCH_CHECK(n < (std::int64_t{1} << 31) - kBlockRows, "blitzgs::", op, ": fewer than 2^31 - ",
                  kBlockRows, " rows are supported, got ", n);
  HeldRows held;
  const auto hold = [&]<class T>(const T*& column, const char* name, std::size_t at, ScalarType dtype,
                                 std::initializer_list<std::int64_t> shape) {
    column = data<T>(held.held.emplace_back(checked(op, name, rows[at], dtype, shape)));
  };
  held.rows.n = n;
  hold(held.rows.means, "means", 0, ScalarType::Float, {n, 3});
  hold(held.rows.scales, "scales", 1, ScalarType::Float, {n, 3});
  if (rows.size() == 2) return held;
  hold(held.rows.exp_avg_means, "exp_avg of means", 2, ScalarType::Float, {n, 3});
  hold(held.rows.exp_avg_sq_means, "exp_avg_sq of means", 3, ScalarType::Float, {n, 3});
  hold(held.rows.exp_avg_scales, "exp_avg of scales", 4, ScalarType::Float, {n, 3});
  hold(held.rows.exp_avg_sq_scales, "exp_avg_sq of scales", 5, ScalarType::Float, {n, 3});
  hold(held.rows.last_step, "last_step", 6, ScalarType::Int, {n});
  hold(held.rows.moment_step, "moment_step", 7, ScalarType::Int, {n});
  hold(held.rows.table, "table", 8, ScalarType::Double, {-1, kAdamTable});
  return held;
}

void check_bounds(const char* op, const Tensor& bounds, std::int64_t rows) {
  check_in_place(op, "bounds", bounds, ScalarType::Float, {blocks_of(rows), kBlockBounds});
}

void update_block_bounds_(Tensor bounds, const std::optional<Tensor>& ids_in,
                          const std::vector<Tensor>& rows) {
  const char* op = "update_block_bounds_";
  const HeldRows held = hold_rows(op, rows);
  check_bounds(op, bounds, held.rows.n);
  const std::optional<Tensor> ids = checked(op, "ids", ids_in, ScalarType::Int, {-1});
  // An empty tensor may have a null pointer, which would mean all rows.
  if (ids && ids->size(0) == 0) return;
  DeviceScope scope(bounds);
  backend::update_block_bounds(held.rows, data_or_null<std::int32_t>(ids), ids ? ids->size(0) : 0,
                               mutable_data<float>(bounds), scope.workspace, scope.stream);
}

std::tuple<Tensor, Tensor, Tensor, Tensor> cull_blocks(
    const Tensor& bounds, const std::vector<Tensor>& rows, const Tensor& viewmats_in, const Tensor& Ks_in,
    std::int64_t width, std::int64_t height, double near_plane, double far_plane, double eps2d,
    const std::optional<Tensor>& level_ranges_in, const std::optional<Tensor>& level,
    const std::vector<double>& reach, std::int64_t lod_views, const std::optional<Tensor>& cull,
    const std::vector<std::int64_t>& columns, std::optional<std::int64_t> capacity_in) {
  const char* op = "cull_blocks";
  const HeldRows held = hold_rows(op, rows);
  check_bounds(op, bounds, held.rows.n);
  const Tensor viewmats = checked(op, "viewmats", viewmats_in, ScalarType::Float, {-1, 4, 4});
  const std::int64_t views = viewmats.size(0);
  STD_TORCH_CHECK(views <= kMaxViews, "blitzgs::", op, ": at most ", kMaxViews, " views at once, got ",
                  views);
  const Tensor Ks = checked(op, "Ks", Ks_in, ScalarType::Float, {views, 3, 3});
  const CullCamera camera{data<float>(viewmats),          data<float>(Ks),
                          static_cast<int>(width),        static_cast<int>(height),
                          static_cast<float>(near_plane), static_cast<float>(far_plane),
                          static_cast<float>(eps2d)};
  STD_TORCH_CHECK(level_ranges_in.has_value() == level.has_value(), "blitzgs::", op,
                  ": a gate needs level_ranges and level");
  BlockGate gate{};
  std::optional<HeldRules> rules;
  const std::optional<Tensor> level_ranges =
      checked(op, "level_ranges", level_ranges_in, ScalarType::Byte, {blocks_of(held.rows.n), 2});
  if (level) {
    rules = hold_rules(op, held.rows.n, static_cast<int>(views), *level, reach, lod_views, cull, columns);
    gate = {rules->rules, data<std::uint8_t>(*level_ranges)};
  }
  DeviceScope scope(bounds);
  const CullInputs in{held.rows, data<float>(bounds), camera, static_cast<int>(views), gate};
  STD_TORCH_CHECK(!capacity_in || *capacity_in > 0, "blitzgs::", op,
                  ": capacity_blocks must be for 1 block or more, got ", *capacity_in);
  const std::int64_t capacity = capacity_in ? std::min(*capacity_in, blocks_of(held.rows.n))
                                            : backend::count_active_blocks(in, scope.workspace, scope.stream);
  Tensor active_ids = make_empty(bounds, {capacity * kBlockRows}, ScalarType::Int);
  Tensor active_views = make_empty(bounds, {capacity * kBlockRows}, ScalarType::Int);
  Tensor count = make_empty(bounds, {1}, ScalarType::Int),
         n_blocks = make_empty(bounds, {1}, ScalarType::Int);
  const ActiveList list{mutable_data<std::int32_t>(active_ids), mutable_data<std::int32_t>(active_views),
                        mutable_data<std::int32_t>(count), mutable_data<std::int32_t>(n_blocks), capacity};
  backend::cull_blocks(in, list, scope.workspace, scope.stream);
  return {active_ids, active_views, count, n_blocks};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("update_block_bounds_", TORCH_BOX(&blitzgs::update_block_bounds_));
  m.impl("cull_blocks", TORCH_BOX(&blitzgs::cull_blocks));
}
