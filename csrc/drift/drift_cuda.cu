// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "drift/drift.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// One thread per value (drift.h).
__global__ void __launch_bounds__(kThreads) add_drift_kernel(const __grid_constant__ DriftStep drift) {
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i < drift_values(drift)) add_drift(drift, i);
}

}  // namespace

void add_drift_step(const DriftStep& drift, Workspace&, CudaStream stream) {
  const std::int64_t values = drift_values(drift);
  if (values == 0) return;
  add_drift_kernel<<<blocks_for(values, kThreads), kThreads, 0, stream>>>(drift);
  check_launch("add_drift_step");
}

}  // namespace blitzgs::cuda
