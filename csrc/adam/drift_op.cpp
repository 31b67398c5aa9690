// SPDX-License-Identifier: Apache-2.0
#include "adam/drift.h"

#include "adam/lazy_adam_op.h"
#include "common/op.h"

namespace blitzgs {
namespace {

// Entry i of a tensor along its first dimension.
Tensor part_of(const Tensor& tensor, std::int64_t i) {
  std::vector<std::int64_t> shape, strides;
  for (std::int64_t axis = 1; axis < tensor.dim(); ++axis) {
    shape.push_back(tensor.size(axis));
    strides.push_back(tensor.stride(axis));
  }
  return view_of(tensor, shape, strides, i * tensor.stride(0));
}

constexpr const char* kOp = "drift_step_";

// Adds a step to the tables of all schedules, float64 [T, S + 1, kAdamTable].
void add_drift(Tensor& tables, Tensor& lr_tables, const std::vector<Tensor>& terms, std::int64_t step,
               const std::vector<double>& rates) {
  check_in_place(kOp, "tables", tables, ScalarType::Double, {-1, -1, kAdamTable});
  const std::int64_t n_tables = tables.size(0), steps = tables.size(1);
  check_in_place(kOp, "lr_tables", lr_tables, ScalarType::Float, {n_tables, steps, kAdamGroups});
  check_in_place(kOp, "decays", terms[0], ScalarType::Double, {-1, kAdamOrders});
  check_in_place(kOp, "shares", terms[1], ScalarType::Double, {steps, kAdamOrders});
  STD_TORCH_CHECK(step > 0 && step < steps, "blitzgs::", kOp, ": step must be 1 to ", steps - 1, ", got ",
                  step);
  STD_TORCH_CHECK(static_cast<std::int64_t>(rates.size()) == n_tables * kAdamGroups, "blitzgs::", kOp, ": ",
                  n_tables * kAdamGroups, " rates are needed, got ", rates.size());
  DeviceScope scope(tables);
  for (std::int64_t first = 0; first < n_tables; first += kMostDriftTables) {
    DriftStep drift{mutable_data<double>(tables) + first * steps * kAdamTable,
                    mutable_data<float>(lr_tables) + first * steps * kAdamGroups,
                    data<double>(terms[0]),
                    data<double>(terms[1]),
                    steps,
                    terms[0].size(0),
                    step,
                    static_cast<int>(std::min<std::int64_t>(n_tables - first, kMostDriftTables)),
                    {}};
    for (int t = 0; t < drift.n_tables; ++t) {
      for (int g = 0; g < kAdamGroups; ++g) {
        // Rounded as in lr_tables.
        drift.rates[t][g] = static_cast<float>(rates[(first + t) * kAdamGroups + g]);
      }
    }
    backend::add_drift_step(drift, scope.workspace, scope.stream);
  }
}

// The rows as int32, which the kernels of lazy_adam read.
Tensor checked_rows(const Tensor& indices) {
  check_dtype(kOp, "indices", indices, ScalarType::Long);
  check_contiguous(kOp, "indices", indices);
  const std::int64_t n = indices.numel();
  Tensor rows = make_empty(indices, {n}, ScalarType::Int);
  DeviceScope scope(indices);
  backend::narrow_rows(data<std::int64_t>(indices), n, mutable_data<std::int32_t>(rows), scope.stream);
  return rows;
}

void drift_step(Tensor tables, Tensor lr_tables, const std::vector<Tensor>& terms,
                const std::vector<Tensor>& states, const std::vector<std::int64_t>& steps,
                const std::vector<double>& decays, const std::vector<double>& rates,
                const std::vector<Tensor>& grads, const Tensor& indices,
                const std::vector<std::int64_t>& current) {
  STD_TORCH_CHECK(terms.size() == 2 && steps.size() == 3, "blitzgs::", kOp,
                  ": expected terms (decays, shares) and steps (step, explicit_steps, sparse), got ",
                  terms.size(), " and ", steps.size(), " entries");
  add_drift(tables, lr_tables, terms, steps[0], rates);
  if (indices.numel() == 0) return;
  const auto n_tables = static_cast<std::size_t>(tables.size(0));
  STD_TORCH_CHECK(states.size() == n_tables * kAdamState && grads.size() == n_tables * kAdamColumns &&
                      current.size() == n_tables,
                  "blitzgs::", kOp, ": each of ", n_tables, " tables needs ", kAdamState, " states, ",
                  kAdamColumns, " grads and a number in current, got ", states.size(), ", ", grads.size(),
                  " and ", current.size());
  const Tensor rows = checked_rows(indices);
  for (std::size_t t = 0; t < n_tables; ++t) {
    const auto state = states.begin() + t * kAdamState;
    const auto own = grads.begin() + t * kAdamColumns;
    AdamTensors adam(kOp, {state, state + kAdamState}, {part_of(tables, t), part_of(lr_tables, t)}, steps,
                     decays);
    adam.step_rows({own, own + kAdamColumns}, rows, current[t] != 0);
  }
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("drift_step_", TORCH_BOX(&blitzgs::drift_step)); }
