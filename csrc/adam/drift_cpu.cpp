// SPDX-License-Identifier: Apache-2.0
#include "adam/drift.h"

#include <algorithm>

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

void narrow_rows(const std::int64_t* indices, std::int64_t n, std::int32_t* rows, CudaStream) {
  std::transform(indices, indices + n, rows, [](std::int64_t i) { return static_cast<std::int32_t>(i); });
}

}  // namespace blitzgs::cpu
