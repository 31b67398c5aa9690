// SPDX-License-Identifier: Apache-2.0
#include "drift/drift.h"

namespace blitzgs::cpu {

void add_drift_step(const DriftStep& drift, Workspace&, CudaStream) {
  const std::int64_t values = drift_values(drift);
  for (std::int64_t i = 0; i < values; ++i) add_drift(drift, i);
}

}  // namespace blitzgs::cpu
