// SPDX-License-Identifier: Apache-2.0
#include "adam/drift.h"
#include "common/cuda.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256, kTailsOfRow = kAdamOrders * kAdamGroups;

// One thread per order and group of a row (drift.h); blockIdx.y is the table.
__global__ void __launch_bounds__(kThreads) add_drift_kernel(const __grid_constant__ DriftStep drift) {
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x, back = i / kTailsOfRow + 1;
  const auto tail = static_cast<int>(i % kTailsOfRow);
  if (back > drift_rows(drift)) return;
  add_drift(drift, static_cast<int>(blockIdx.y), back, tail / kAdamGroups, tail % kAdamGroups);
}

// One thread per row.
__global__ void __launch_bounds__(kThreads)
    narrow_rows_kernel(const std::int64_t* indices, std::int64_t n, std::int32_t* rows) {
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i < n) rows[i] = static_cast<std::int32_t>(indices[i]);
}

}  // namespace

void add_drift_step(const DriftStep& drift, Workspace&, CudaStream stream) {
  if (drift.n_tables == 0 || drift_rows(drift) == 0) return;
  const dim3 blocks(blocks_for(drift_rows(drift) * kTailsOfRow, kThreads),
                    static_cast<unsigned>(drift.n_tables));
  add_drift_kernel<<<blocks, kThreads, 0, stream>>>(drift);
  check_launch("drift_step");
}

void narrow_rows(const std::int64_t* indices, std::int64_t n, std::int32_t* rows, CudaStream stream) {
  if (n == 0) return;
  narrow_rows_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(indices, n, rows);
  check_launch("drift_step");
}

}  // namespace blitzgs::cuda
