// SPDX-License-Identifier: Apache-2.0
// Zeroes a few counters between kernels that are launched early. A memset there would bring back the gaps
// before and behind it.
#pragma once
#include <cstdint>

#include "common/launch.cuh"

namespace blitzgs::cuda {

static __global__ void zero_kernel(std::int32_t* counters, std::int64_t n) {
  wait_for_earlier_kernels();
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < n) counters[i] = 0;
}

inline void zero(const char* what, std::int32_t* counters, std::int64_t n, CudaStream stream) {
  launch_early(what, zero_kernel, {blocks_for(n, 256), 256, stream}, counters, n);
}

}  // namespace blitzgs::cuda
