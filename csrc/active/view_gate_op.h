// SPDX-License-Identifier: Apache-2.0
// The checked arguments of the ops that drop rows from views: level [N], reach, lod_views, cull, columns.
#pragma once
#include <optional>
#include <vector>

#include "active/view_gate.h"
#include "common/op.h"

namespace blitzgs {

// The checked rules, and the tensors that they point to, which must live during the call.
struct HeldRules {
  Tensor level;
  std::optional<Tensor> cull;
  GateRules rules{};
};

inline void set_reach(const char* op, const std::vector<double>& reach, GateRules& rules) {
  STD_TORCH_CHECK(!reach.empty() && reach.size() <= kMaxLevels, "blitzgs::", op, ": 1 to ", kMaxLevels,
                  " levels are supported, got ", reach.size());
  rules.n_levels = static_cast<int>(reach.size());
  for (int level = 0; level < rules.n_levels; ++level) {
    STD_TORCH_CHECK(level == 0 || reach[level] <= reach[level - 1], "blitzgs::", op,
                    ": finer levels reach no farther, got ", reach[level - 1], " and ", reach[level],
                    " for the levels ", level - 1, " and ", level);
    rules.table.reach2[level] = reach[level] < 0 ? -1.0f : static_cast<float>(reach[level] * reach[level]);
  }
}

inline void set_columns(const char* op, const std::vector<std::int64_t>& columns, bool has_cull,
                        GateRules& rules) {
  if (columns.empty()) return;
  STD_TORCH_CHECK(static_cast<int>(columns.size()) == rules.n_views, "blitzgs::", op, ": ", rules.n_views,
                  " views need as many columns of the cull matrix, got ", columns.size());
  STD_TORCH_CHECK(has_cull, "blitzgs::", op, ": columns need a cull matrix");
  for (int view = 0; view < rules.n_views; ++view) {
    STD_TORCH_CHECK(columns[view] < rules.cull_columns, "blitzgs::", op, ": the cull matrix has ",
                    rules.cull_columns, " columns, got column ", columns[view]);
    rules.table.columns[view] = static_cast<std::int32_t>(columns[view]);
    if (columns[view] >= 0) rules.cull_views |= 1u << view;
  }
}

inline HeldRules hold_rules(const char* op, std::int64_t rows, int views, const Tensor& level,
                            const std::vector<double>& reach, std::int64_t lod_views,
                            const std::optional<Tensor>& cull, const std::vector<std::int64_t>& columns) {
  HeldRules held{checked(op, "level", level, ScalarType::Byte, {rows}),
                 checked(op, "cull", cull, ScalarType::Int, {blocks_of(rows), -1, kSectorWords})};
  if (held.cull) held.rules.cull_columns = held.cull->size(1);
  held.rules.level = data<std::uint8_t>(held.level);
  held.rules.cull = data_or_null<std::int32_t>(held.cull);
  held.rules.n_rows = rows;
  held.rules.n_views = views;
  held.rules.lod_views = static_cast<std::uint32_t>(lod_views);
  set_reach(op, reach, held.rules);
  set_columns(op, columns, cull.has_value(), held.rules);
  return held;
}

}  // namespace blitzgs
