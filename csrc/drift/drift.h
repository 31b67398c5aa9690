// SPDX-License-Identifier: Apache-2.0
// Adds a step to the tables of schedules (lazy_adam.h) whose learning rates become known step by step. Each
// row of an earlier step gets the step's term of its tails; rows of steps further back than `reach` need no
// term (blitzgs/optim/drift.py). For the step s with learning rates r_g, the rows t = s - reach .. s - 1,
// orders k and groups g:
//   tail_k[t] += decays[reach - (s - t)][k] shares[s][k] r_g,   and lr_table[s][g] = r_g.
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "lazy_adam/lazy_adam.h"

namespace blitzgs {

constexpr int kMostDriftTables = 16;  // tables of one launch
constexpr int kTailsOfRow = kAdamOrders * kAdamGroups;

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

// The number of values to change, of which `add_drift` changes one.
BLITZGS_HD std::int64_t drift_values(const DriftStep& drift) {
  return drift.n_tables * drift_rows(drift) * kTailsOfRow;
}

BLITZGS_HD void add_drift(const DriftStep& drift, std::int64_t i) {
  const std::int64_t rows = drift_rows(drift), back = i / kTailsOfRow % rows + 1;
  const auto table = static_cast<int>(i / kTailsOfRow / rows), tail = static_cast<int>(i % kTailsOfRow),
             order = tail / kAdamGroups, group = tail % kAdamGroups;
  const double rate = drift.rates[table][group];
  const double term = drift.shares[drift.step * kAdamOrders + order] * rate;
  const std::int64_t first = table * drift.steps + drift.step;  // the row of the step itself
  drift.tables[(first - back) * kAdamTable + kTails + tail] +=
      drift.decays[(drift.reach - back) * kAdamOrders + order] * term;
  if (back == 1 && order == 0) drift.lr_tables[first * kAdamGroups + group] = static_cast<float>(rate);
}

namespace cpu {
void add_drift_step(const DriftStep&, Workspace&, CudaStream);
}
namespace cuda {
void add_drift_step(const DriftStep&, Workspace&, CudaStream);
}

}  // namespace blitzgs
