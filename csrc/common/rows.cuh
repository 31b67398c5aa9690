// SPDX-License-Identifier: Apache-2.0
// for_each_row (rows.h) on CUDA, for the kernel files that instantiate it.
#pragma once
#include "common/cuda.cuh"
#include "common/rows.h"

namespace blitzgs::cuda {

inline constexpr int kRowThreads = 256;

// One thread per row.
template <class Rows>
static __global__ void __launch_bounds__(kRowThreads) row_kernel(const __grid_constant__ Rows work) {
  wait_for_earlier_kernels();
  const std::int64_t i = blockIdx.x * std::int64_t{kRowThreads} + threadIdx.x;
  if (i < work.n) work(i);
}

template <class Rows>
void for_each_row(const Rows& work, CudaStream stream) {
  if (work.n == 0) return;
  launch_early("rows", row_kernel<Rows>, {blocks_for(work.n, kRowThreads), kRowThreads, stream}, work);
}

}  // namespace blitzgs::cuda
