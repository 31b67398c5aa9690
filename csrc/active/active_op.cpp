// SPDX-License-Identifier: Apache-2.0
#include "active/blocks.h"

#include "active/pool.h"
#include "active/view_gate.h"
#include "common/op.h"

namespace blitzgs {
namespace {

// The checked rules, and the tensors that they point to, which must live during the call.
struct HeldRules {
  Values<const uint8_t> level;
  OptionalValues<const int32_t> cull;
  GateRules rules{};
};

void set_reach(const FloatList& reach, GateRules& rules) {
  BLITZGS_CHECK(!reach.empty() && reach.size() <= kMaxLevels, "1 to ", kMaxLevels,
                " levels are supported, got ", reach.size());
  rules.n_levels = int(reach.size());
  for (int level = 0; level < rules.n_levels; ++level) {
    BLITZGS_CHECK(level == 0 || reach[level] <= reach[level - 1], "finer levels reach no farther, got ",
                  reach[level - 1], " and ", reach[level], " for the levels ", level - 1, " and ", level);
    rules.table.reach2[level] = reach[level] < 0 ? -1.0f : float(reach[level] * reach[level]);
  }
}

void set_columns(const IntList& columns, bool has_cull, GateRules& rules) {
  if (columns.empty()) return;
  BLITZGS_CHECK(int(columns.size()) == rules.n_views, rules.n_views,
                " views need as many columns of the cull matrix, got ", columns.size());
  BLITZGS_CHECK(has_cull, "columns need a cull matrix");
  for (int view = 0; view < rules.n_views; ++view) {
    BLITZGS_CHECK(columns[view] < rules.cull_columns, "the cull matrix has ", rules.cull_columns,
                  " columns, got column ", columns[view]);
    rules.table.columns[view] = int32_t(columns[view]);
    if (columns[view] >= 0) rules.cull_views |= 1u << view;
  }
}

HeldRules hold_rules(int64_t rows, int views, const Tensor& level, const FloatList& reach, int64_t lod_views,
                     const OptionalTensor& cull, const IntList& columns) {
  HeldRules held{checked<uint8_t>("level", level, {rows}),
                 checked<int32_t>("cull", cull, {blocks_of(rows), -1, kSectorWords})};
  if (held.cull) held.rules.cull_columns = held.cull->size(1);
  held.rules.level = held.level;
  held.rules.cull = held.cull;
  held.rules.n_rows = rows;
  held.rules.n_views = views;
  held.rules.lod_views = uint32_t(lod_views);
  set_reach(reach, held.rules);
  set_columns(columns, cull.has_value(), held.rules);
  return held;
}

// The columns of the table, checked. `held` keeps the tensors alive during the call.
struct HeldRows {
  TensorList held;
  BlockRows rows{};
};

// rows: (means, scales), and if steps may be pending also the moments (exp_avg and exp_avg_sq of the means,
// then of the scales), last_step, moment_step and table. blitzgs/ops/blocks.py builds this group.
HeldRows hold_rows(const TensorList& rows) {
  BLITZGS_CHECK(rows.size() == 2 || rows.size() == 9,
                "rows must be (means, scales) or, with pending steps, (means, scales, exp_avg_means, "
                "exp_avg_sq_means, exp_avg_scales, exp_avg_sq_scales, last_step, moment_step, table), got ",
                rows.size(), " tensors");
  const int64_t n = rows[0].size(0);
  BLITZGS_CHECK(n < (int64_t{1} << 31) - kBlockRows, "fewer than 2^31 - ", kBlockRows,
                " rows are supported, got ", n);
  HeldRows held;
  BlockRows& b = held.rows;
  const auto hold = [&]<class T>(const T*& column, const char* name, size_t at,
                                 std::initializer_list<int64_t> shape) {
    column = data<T>(held.held.emplace_back(checked<T>(name, rows[at], shape)));
  };
  b.n = n;
  hold(b.means, "means", 0, {n, 3});
  hold(b.scales, "scales", 1, {n, 3});
  if (rows.size() == 2) return held;
  hold(b.exp_avg_means, "exp_avg of means", 2, {n, 3});
  hold(b.exp_avg_sq_means, "exp_avg_sq of means", 3, {n, 3});
  hold(b.exp_avg_scales, "exp_avg of scales", 4, {n, 3});
  hold(b.exp_avg_sq_scales, "exp_avg_sq of scales", 5, {n, 3});
  hold(b.last_step, "last_step", 6, {n});
  hold(b.moment_step, "moment_step", 7, {n});
  hold(b.table, "table", 8, {-1, kAdamTable});
  return held;
}

Values<const float> checked_viewmats(const Tensor& viewmats) {
  const auto found = checked<float>("viewmats", viewmats, {-1, 4, 4});
  BLITZGS_CHECK(found.size(0) <= kMaxViews, "at most ", kMaxViews, " views at once, got ", found.size(0));
  return found;
}

void update_block_bounds_(const Tensor& bounds_in, const OptionalTensor& ids_in, const TensorList& rows) {
  const HeldRows held = hold_rows(rows);
  const auto bounds = checked_in_place<float>("bounds", bounds_in, {blocks_of(held.rows.n), kBlockBounds});
  const auto ids = checked<int32_t>("ids", ids_in, {-1});
  // An empty tensor may have a null pointer, which would mean all rows.
  if (ids && ids->size(0) == 0) return;
  DeviceScope scope(bounds);
  backend::update_block_bounds(held.rows, ids, ids ? ids->size(0) : 0, bounds, scope.workspace, scope.stream);
}

Tensors<4> cull_blocks(const Tensor& bounds_in, const TensorList& rows, const Tensor& viewmats_in,
                       const Tensor& Ks_in, int64_t width, int64_t height, double near_plane,
                       double far_plane, double eps2d, const OptionalTensor& level_ranges_in,
                       const OptionalTensor& level, const FloatList& reach, int64_t lod_views,
                       const OptionalTensor& cull, const IntList& columns,
                       std::optional<int64_t> capacity_in) {
  const HeldRows held = hold_rows(rows);
  const int64_t blocks = blocks_of(held.rows.n);
  const auto bounds = checked_in_place<float>("bounds", bounds_in, {blocks, kBlockBounds});
  const auto viewmats = checked_viewmats(viewmats_in);
  const auto views = int(viewmats.size(0));
  const auto Ks = checked<float>("Ks", Ks_in, {views, 3, 3});
  const CullCamera camera{viewmats,         Ks,          int(width), int(height), float(near_plane),
                          float(far_plane), float(eps2d)};
  BLITZGS_CHECK(level_ranges_in.has_value() == level.has_value(), "a gate needs level_ranges and level");
  BlockGate gate{};
  std::optional<HeldRules> rules;
  const auto level_ranges = checked<uint8_t>("level_ranges", level_ranges_in, {blocks, 2});
  if (level) {
    rules = hold_rules(held.rows.n, views, *level, reach, lod_views, cull, columns);
    gate = {rules->rules, level_ranges};
  }
  DeviceScope scope(bounds);
  const CullInputs in{held.rows, bounds, camera, views, gate};
  BLITZGS_CHECK(!capacity_in || *capacity_in > 0, "capacity_blocks must be for 1 block or more, got ",
                *capacity_in);
  const int64_t capacity = capacity_in ? std::min(*capacity_in, blocks)
                                       : backend::count_active_blocks(in, scope.workspace, scope.stream);
  const auto ids = make<int32_t>(bounds, {capacity * kBlockRows}),
             active_views = make<int32_t>(bounds, {capacity * kBlockRows}),
             count = make<int32_t>(bounds, {1}), n_blocks = make<int32_t>(bounds, {1});
  backend::cull_blocks(in, {ids, active_views, count, n_blocks, capacity}, scope.workspace, scope.stream);
  return {ids, active_views, count, n_blocks};
}

// Kernels read one of the two layouts and write the other.
int32_t* words_of(const Tensor& layout) { return static_cast<int32_t*>(layout.mutable_data_ptr()); }

Tensor sectors_of_rows(const Tensor& rows_in) {
  const auto rows = checked<int32_t>("rows", rows_in, {-1, -1});
  const int64_t n = rows.size(0), words = rows.size(1);
  const auto sectors = make<int32_t>(rows, {blocks_of(n), 32 * words, kSectorWords});
  DeviceScope scope(rows);
  backend::sectors_of_rows({words_of(rows), sectors, n, words}, scope.stream);
  return sectors;
}

Tensor rows_of_sectors(const Tensor& sectors_in, int64_t n) {
  const auto sectors = checked<int32_t>("sectors", sectors_in, {blocks_of(n), -1, kSectorWords});
  BLITZGS_CHECK(sectors.size(1) % 32 == 0, "sectors must be of a multiple of 32 columns, got ",
                sectors.size(1));
  const int64_t words = sectors.size(1) / 32;
  const auto rows = make<int32_t>(sectors, {n, words});
  DeviceScope scope(sectors);
  backend::rows_of_sectors({rows, words_of(sectors), n, words}, scope.stream);
  return rows;
}

void gate_views_(const Tensor& ids_in, const Tensor& views_in, const OptionalTensor& count,
                 const Tensor& means_in, const Tensor& level_in, const Tensor& viewmats_in,
                 const FloatList& reach, int64_t lod_views, const OptionalTensor& cull_in,
                 const IntList& columns) {
  const auto ids = checked<int32_t>("ids", ids_in, {-1});
  const int64_t capacity = ids.size(0);
  const auto views = checked_in_place<int32_t>("views", views_in, {capacity});
  const auto means = checked<float>("means", means_in, {-1, 3});
  const auto viewmats = checked_viewmats(viewmats_in);
  const HeldRules held =
      hold_rules(means.size(0), int(viewmats.size(0)), level_in, reach, lod_views, cull_in, columns);
  if (!leaves_out_any(held.rules)) return;
  DeviceScope scope(views);
  backend::gate_views(
      {ids, views, max_listed(count, capacity), data_or_null<int32_t>(count), means, viewmats, held.rules},
      scope.stream);
}

Tensor seen_blocks(const Tensor& bounds_in, const Tensor& viewmats_in, const Tensor& Ks_in,
                   const Tensor& sizes_in, double near_plane, double far_plane, double eps2d) {
  const auto bounds = checked<float>("bounds", bounds_in, {-1, kBlockBounds}),
             viewmats = checked_viewmats(viewmats_in);
  const int64_t views = viewmats.size(0);
  const auto Ks = checked<float>("Ks", Ks_in, {views, 3, 3});
  const auto sizes = checked<int32_t>("sizes", sizes_in, {views, 2});
  const auto seen = make<int32_t>(bounds, {bounds.size(0)});
  DeviceScope scope(bounds);
  backend::seen_blocks({bounds, bounds.size(0), viewmats, Ks, sizes, int(views), float(near_plane),
                        float(far_plane), float(eps2d), seen},
                       scope.stream);
  return seen;
}

// Checks a column of the pool and of the table, and returns the bytes of a block of this column.
int64_t check_pair(const Tensor& pool, const Tensor& table) {
  BLITZGS_CHECK(pool.dim() >= 1 && pool.dim() == table.dim(),
                "columns must have rows, and as many axes in pool and table; got ", shape_of(pool), " and ",
                shape_of(table));
  check_dtype("a column of the pool", pool, table.scalar_type());
  for (int64_t axis = 1; axis < pool.dim(); ++axis) {
    BLITZGS_CHECK(pool.size(axis) == table.size(axis), "rows of pool and table must be alike, got ",
                  shape_of(pool), " and ", shape_of(table));
  }
  for (const Tensor* column : {&pool, &table}) check_contiguous("columns", *column);
  BLITZGS_CHECK(table.is_cpu(), "the table must be in the memory of the host");
  return kBlockRows * elements_behind(pool) * int64_t(pool.element_size());
}

void swap_blocks_(const TensorList& pool, const TensorList& table, int64_t n_written, const Tensor& slots,
                  const Tensor& leaving, const Tensor& coming) {
  const auto n_columns = int64_t(pool.size());
  BLITZGS_CHECK(n_columns <= kMaxSwapColumns && table.size() == pool.size(),
                "pool and table must have the same columns, at most ", kMaxSwapColumns, "; got ", n_columns,
                " and ", table.size());
  SwapBlocks swap{};
  swap.n = slots.size(0);
  swap.slots = checked_in_place<int32_t>("slots", slots, {swap.n});
  swap.leaving = checked_in_place<int32_t>("leaving", leaving, {swap.n});
  swap.coming = checked_in_place<int32_t>("coming", coming, {swap.n});
  for (int64_t c = 0; c < n_columns; ++c) {
    const int64_t bytes = check_pair(pool[c], table[c]);
    if (bytes == 0) continue;
    swap.columns[swap.n_columns++] = {static_cast<std::byte*>(pool[c].mutable_data_ptr()),
                                      static_cast<std::byte*>(table[c].mutable_data_ptr()), bytes,
                                      c < n_written};
  }
  if (swap.n == 0 || n_columns == 0) return;
  DeviceScope scope(slots);
  backend::swap_blocks(swap, scope.stream);
}

Tensor morton_keys(const Tensor& points) {
  const auto rows = checked<float>("points", points, {-1, 3});
  const auto keys = make<int64_t>(rows, {rows.size(0)});
  DeviceScope scope(rows);
  backend::morton_keys(rows, rows.size(0), keys, scope.workspace, scope.stream);
  return keys;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "update_block_bounds_", update_block_bounds_);
  BLITZGS_OP(m, "cull_blocks", cull_blocks);
  BLITZGS_OP(m, "sectors_of_rows", sectors_of_rows);
  BLITZGS_OP(m, "rows_of_sectors", rows_of_sectors);
  BLITZGS_OP(m, "gate_views_", gate_views_);
  BLITZGS_OP(m, "seen_blocks", seen_blocks);
  BLITZGS_OP(m, "swap_blocks_", swap_blocks_);
  BLITZGS_OP(m, "morton_keys", morton_keys);
}
