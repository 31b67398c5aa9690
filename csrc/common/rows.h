// SPDX-License-Identifier: Apache-2.0
// Work on rows that do not know each other: a struct with the number n of rows, whose operator() does the
// work of row i. For CUDA, a kernel file of the struct's folder instantiates for_each_row.
#pragma once
#include "common/kernel.h"
#include "common/parallel.h"
#ifdef __CUDACC__
#include "common/cuda.cuh"
#endif

namespace blitzgs::BLITZGS_BACKEND {

// Does the work of rows 0 to n - 1, on CUDA with a thread for each.
template <class Rows>
void for_each_row(const Rows& work, CudaStream)
#ifdef BLITZGS_BACKEND_CUDA
    ;
#else
{
  parallel_rows(work.n, 4096, [&](int64_t i) { work(i); });
}
#endif

}  // namespace blitzgs::BLITZGS_BACKEND

#ifdef __CUDACC__
namespace blitzgs::cuda {

inline constexpr int kRowThreads = 256;

template <class Rows>
static __global__ void __launch_bounds__(kRowThreads) row_kernel(const __grid_constant__ Rows work) {
  wait_for_earlier_kernels();
  const int64_t i = blockIdx.x * int64_t{kRowThreads} + threadIdx.x;
  if (i < work.n) work(i);
}

template <class Rows> void for_each_row(const Rows& work, CudaStream stream) {
  if (work.n == 0) return;
  launch_early("rows", row_kernel<Rows>, {blocks_for(work.n, kRowThreads), kRowThreads, stream}, work);
}

}  // namespace blitzgs::cuda
#endif
