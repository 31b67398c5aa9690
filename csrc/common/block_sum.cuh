// SPDX-License-Identifier: Apache-2.0
#pragma once
#include "common/warp.cuh"

namespace blitzgs::cuda {

// Sum over a block of THREADS threads, on thread 0.
template <int THREADS>
__device__ double block_sum(double value) {
  __shared__ double warps[THREADS / 32];
  for (int offset = 16; offset > 0; offset /= 2) value += __shfl_down_sync(kFullWarp, value, offset);
  __syncthreads();
  if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = value;
  __syncthreads();
  double total = 0;
  if (threadIdx.x == 0) {
    for (const double part : warps) total += part;
  }
  return total;
}

}  // namespace blitzgs::cuda
