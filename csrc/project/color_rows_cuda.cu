// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "project/color_rows.h"
#include "project/project_device.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// One thread per row.
__global__ void __launch_bounds__(kThreads)
    number_rows_kernel(const NumberedRows numbered, const ProjectCapacity capacity) {
  const std::int64_t u = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (u < fitting(capacity).visible) number_row(numbered, static_cast<std::int32_t>(u));
}

}  // namespace

void number_rows(const NumberedRows& numbered, const ProjectCapacity& capacity, CudaStream stream) {
  if (capacity.sizes.visible == 0) return;
  number_rows_kernel<<<blocks_for(capacity.sizes.visible, kThreads), kThreads, 0, stream>>>(numbered,
                                                                                            capacity);
  check_launch("color_rows");
}

}  // namespace blitzgs::cuda
