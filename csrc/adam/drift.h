// SPDX-License-Identifier: Apache-2.0
// Adds a step to the tables of schedules (lazy_adam.h) whose learning rates become known step by step. Each
// row of an earlier step gets the step's term of its tails; rows of steps further back than `reach` need no
// term (blitzgs/optim/drift.py). For the step s with learning rates r_g, the rows t = s - reach .. s - 1,
// orders k and groups g:
//   tail_k[t] += decays[reach - (s - t)][k] shares[s][k] r_g,   and lr_table[s][g] = r_g.
// narrow_rows turns the int64 indices of a sparse gradient into the int32 rows that lazy_adam takes.
#pragma once
#include <cstdint>

#include "adam/lazy_adam.h"
#include "common/kernel.h"

namespace blitzgs {

constexpr int kMostDriftTables = 16;  // tables of one launch

// tables double [n_tables, steps, kAdamTable] and lr_tables float [n_tables, steps, kAdamGroups]; decays
// [reach, kAdamOrders]; shares [steps, kAdamOrders]; 0 < step < steps.
struct DriftStep {
  double* tables;
  float* lr_tables;
  const double *decays, *shares;
  std::int64_t steps, reach, step;
  int n_tables;
  double rates[kMostDriftTables][kAdamGroups];
};

BLITZGS_HD std::int64_t drift_rows(const DriftStep& drift) {
  return drift.step < drift.reach ? drift.step : drift.reach;
}

// Adds the term of one order and group to the row `back` steps before the step, 1 <= back <= drift_rows().
BLITZGS_HD void add_drift(const DriftStep& drift, int table, std::int64_t back, int order, int group) {
  const double rate = drift.rates[table][group];
  const double term = drift.shares[drift.step * kAdamOrders + order] * rate;
  const std::int64_t row = table * drift.steps + drift.step;  // of the step itself
  drift.tables[(row - back) * kAdamTable + kTails + order * kAdamGroups + group] +=
      drift.decays[(drift.reach - back) * kAdamOrders + order] * term;
  if (back == 1 && order == 0) drift.lr_tables[row * kAdamGroups + group] = static_cast<float>(rate);
}

namespace BLITZGS_BACKEND {
void add_drift_step(const DriftStep&, Workspace&, CudaStream);
void narrow_rows(const std::int64_t* indices, std::int64_t n, std::int32_t* rows, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
