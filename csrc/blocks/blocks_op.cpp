// SPDX-License-Identifier: Apache-2.0
#include "blocks/blocks.h"

#include <algorithm>
#include <tuple>

#include "common/op.h"
#include "view_gate/view_gate_op.h"

namespace blitzgs {
namespace {

// The columns of the table, checked. `held` keeps the tensors alive during the call.
struct HeldRows {
  std::vector<Tensor> held;
  BlockRows rows{};
};

const float* hold_column(const char* op, const char* name, const Tensor& column, std::int64_t n,
                         HeldRows& held) {
  check_dtype(op, name, column, ScalarType::Float);
  check_shape(op, name, column, {n, 3});
  held.held.push_back(as_contiguous(column));
  return data<float>(held.held.back());
}

const std::int32_t* hold_steps(const char* op, const char* name, const Tensor& column, std::int64_t n,
                               HeldRows& held) {
  check_dtype(op, name, column, ScalarType::Int);
  check_shape(op, name, column, {n});
  held.held.push_back(as_contiguous(column));
  return data<std::int32_t>(held.held.back());
}

// rows: (means, scales), and if steps may be pending also the moments (exp_avg and exp_avg_sq of the means,
// then of the scales), last_step, moment_step and table. blitzgs/ops/blocks.py builds this group.
HeldRows hold_rows(const char* op, const std::vector<Tensor>& rows) {
  STD_TORCH_CHECK(rows.size() == 2 || rows.size() == 9, "blitzgs::", op,
                  ": rows must be (means, scales) or, with pending steps, (means, scales, exp_avg_means, "
                  "exp_avg_sq_means, exp_avg_scales, exp_avg_sq_scales, last_step, moment_step, table), got ",
                  rows.size(), " tensors");
  const Tensor &means = rows[0], &scales = rows[1];
  HeldRows held;
  const std::int64_t n = means.size(0);
  STD_TORCH_CHECK(n < (std::int64_t{1} << 31) - kBlockRows, "blitzgs::", op, ": fewer than 2^31 - ",
                  kBlockRows, " rows are supported, got ", n);
  held.rows.n = n;
  held.rows.means = hold_column(op, "means", means, n, held);
  held.rows.scales = hold_column(op, "scales", scales, n, held);
  if (rows.size() == 2) return held;
  held.rows.exp_avg_means = hold_column(op, "exp_avg of means", rows[2], n, held);
  held.rows.exp_avg_sq_means = hold_column(op, "exp_avg_sq of means", rows[3], n, held);
  held.rows.exp_avg_scales = hold_column(op, "exp_avg of scales", rows[4], n, held);
  held.rows.exp_avg_sq_scales = hold_column(op, "exp_avg_sq of scales", rows[5], n, held);
  held.rows.last_step = hold_steps(op, "last_step", rows[6], n, held);
  held.rows.moment_step = hold_steps(op, "moment_step", rows[7], n, held);
  const Tensor& table = rows[8];
  check_dtype(op, "table", table, ScalarType::Double);
  check_shape(op, "table", table, {-1, kAdamTable});
  held.held.push_back(as_contiguous(table));
  held.rows.table = data<double>(held.held.back());
  return held;
}

void check_bounds(const char* op, const Tensor& bounds, std::int64_t rows) {
  check_in_place(op, "bounds", bounds, ScalarType::Float, {blocks_of(rows), kBlockBounds});
}

Tensor morton_keys(const Tensor& points) {
  check_dtype("morton_keys", "points", points, ScalarType::Float);
  check_shape("morton_keys", "points", points, {-1, 3});
  const Tensor rows = as_contiguous(points);
  Tensor keys = make_empty(rows, {rows.size(0)}, ScalarType::Long);
  DeviceScope scope(rows);
  backend::morton_keys(data<float>(rows), rows.size(0), mutable_data<std::int64_t>(keys), scope.workspace,
                       scope.stream);
  return keys;
}

void update_block_bounds_(Tensor bounds, const std::optional<Tensor>& ids_in,
                          const std::vector<Tensor>& rows) {
  const char* op = "update_block_bounds_";
  const HeldRows held = hold_rows(op, rows);
  check_bounds(op, bounds, held.rows.n);
  std::optional<Tensor> ids;
  if (ids_in) {
    check_dtype(op, "ids", *ids_in, ScalarType::Int);
    check_shape(op, "ids", *ids_in, {-1});
    ids = as_contiguous(*ids_in);
    if (ids->size(0) == 0) return;  // an empty tensor may have a null pointer, which would mean all rows
  }
  DeviceScope scope(bounds);
  backend::update_block_bounds(held.rows, data_or_null<std::int32_t>(ids), ids ? ids->size(0) : 0,
                               mutable_data<float>(bounds), scope.workspace, scope.stream);
}

std::tuple<Tensor, Tensor, Tensor, Tensor> cull_blocks(
    const Tensor& bounds, const std::vector<Tensor>& rows, const std::vector<Tensor>& cameras,
    const std::vector<std::int64_t>& size, const std::vector<double>& limits,
    const std::optional<Tensor>& level_ranges_in, const std::optional<Tensor>& level,
    const std::vector<double>& reach, std::int64_t lod_views, const std::optional<Tensor>& cull,
    const std::vector<std::int64_t>& columns, std::optional<std::int64_t> capacity_in) {
  const char* op = "cull_blocks";
  STD_TORCH_CHECK(cameras.size() == 2 && size.size() == 2 && limits.size() == 3, "blitzgs::", op,
                  ": cameras are viewmats and Ks, size is width and height, limits are near_plane, "
                  "far_plane and eps2d; got ",
                  cameras.size(), ", ", size.size(), " and ", limits.size(), " of them");
  const Tensor &viewmats_in = cameras[0], &Ks_in = cameras[1];
  const HeldRows held = hold_rows(op, rows);
  check_bounds(op, bounds, held.rows.n);
  check_dtype(op, "viewmats", viewmats_in, ScalarType::Float);
  check_shape(op, "viewmats", viewmats_in, {-1, 4, 4});
  const std::int64_t views = viewmats_in.size(0);
  STD_TORCH_CHECK(views <= kMaxViews, "blitzgs::", op, ": at most ", kMaxViews, " views at once, got ",
                  views);
  check_dtype(op, "Ks", Ks_in, ScalarType::Float);
  check_shape(op, "Ks", Ks_in, {views, 3, 3});
  const Tensor viewmats = as_contiguous(viewmats_in), Ks = as_contiguous(Ks_in);
  const CullCamera camera{data<float>(viewmats),         data<float>(Ks),
                          static_cast<int>(size[0]),     static_cast<int>(size[1]),
                          static_cast<float>(limits[0]), static_cast<float>(limits[1]),
                          static_cast<float>(limits[2])};
  STD_TORCH_CHECK(level_ranges_in.has_value() == level.has_value(), "blitzgs::", op,
                  ": a gate needs level_ranges and level");
  BlockGate gate{};
  std::optional<HeldRules> rules;
  std::optional<Tensor> level_ranges;
  if (level) {
    check_dtype(op, "level_ranges", *level_ranges_in, ScalarType::Byte);
    check_shape(op, "level_ranges", *level_ranges_in, {blocks_of(held.rows.n), 2});
    level_ranges = as_contiguous(*level_ranges_in);
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
  m.impl("morton_keys", TORCH_BOX(&blitzgs::morton_keys));
  m.impl("update_block_bounds_", TORCH_BOX(&blitzgs::update_block_bounds_));
  m.impl("cull_blocks", TORCH_BOX(&blitzgs::cull_blocks));
}
