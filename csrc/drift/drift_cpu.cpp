// SPDX-License-Identifier: Apache-2.0
#include "drift/drift.h"

namespace blitzgs::cpu {

void add_drift_step(const DriftStep& drift, Workspace&, CudaStream) {
  for (int table = 0; table < drift.n_tables; ++table) {
    for (std::int64_t back = 1; back <= drift_rows(drift); ++back) {
      for (int order = 0; order < kAdamOrders; ++order) {
        for (int group = 0; group < kAdamGroups; ++group) add_drift(drift, table, back, order, group);
      }
    }
  }
}

}  // namespace blitzgs::cpu
