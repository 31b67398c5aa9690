// SPDX-License-Identifier: Apache-2.0
#include "drift/drift.h"

#include "common/op.h"

namespace blitzgs {
namespace {

void add_drift_step_(Tensor tables, Tensor lr_tables, const Tensor& decays, const Tensor& shares,
                     std::int64_t step, const std::vector<double>& rates) {
  constexpr const char* kOp = "add_drift_step_";
  check_in_place(kOp, "tables", tables, ScalarType::Double, {-1, -1, kAdamTable});
  const std::int64_t n_tables = tables.size(0), steps = tables.size(1);
  check_in_place(kOp, "lr_tables", lr_tables, ScalarType::Float, {n_tables, steps, kAdamGroups});
  check_in_place(kOp, "decays", decays, ScalarType::Double, {-1, kAdamOrders});
  check_in_place(kOp, "shares", shares, ScalarType::Double, {steps, kAdamOrders});
  STD_TORCH_CHECK(step > 0 && step < steps, "blitzgs::", kOp, ": step must be 1 to ", steps - 1, ", got ",
                  step);
  STD_TORCH_CHECK(static_cast<std::int64_t>(rates.size()) == n_tables * kAdamGroups, "blitzgs::", kOp, ": ",
                  n_tables * kAdamGroups, " rates are needed, got ", rates.size());
  DeviceScope scope(tables);
  for (std::int64_t first = 0; first < n_tables; first += kMostDriftTables) {
    DriftStep drift{mutable_data<double>(tables) + first * steps * kAdamTable,
                    mutable_data<float>(lr_tables) + first * steps * kAdamGroups,
                    data<double>(decays),
                    data<double>(shares),
                    steps,
                    decays.size(0),
                    step,
                    static_cast<int>(std::min<std::int64_t>(n_tables - first, kMostDriftTables)),
                    {}};
    for (int t = 0; t < drift.n_tables; ++t) {
      std::copy_n(rates.begin() + (first + t) * kAdamGroups, kAdamGroups, drift.rates[t]);
    }
    backend::add_drift_step(drift, scope.workspace, scope.stream);
  }
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("add_drift_step_", TORCH_BOX(&blitzgs::add_drift_step_)); }
