// SPDX-License-Identifier: Apache-2.0
#pragma once
#include "view_gate/view_gate.h"

namespace blitzgs::cuda {

// Copies the table of the rules and works out the centres. All threads of a block call this, then wait for
// one another.
__device__ inline void fill_gate_table(const GateRules& rules, const float* viewmats, GateTable& table) {
  const int thread = threadIdx.x;
  if (thread < kMaxLevels) table.reach2[thread] = rules.table.reach2[thread];
  if (thread < rules.n_views) {
    table.columns[thread] = rules.table.columns[thread];
    camera_centre(viewmats + 16 * thread, table.centres[thread]);
  }
}

}  // namespace blitzgs::cuda
