// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "common/rows.h"
#include "render/render.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 256;

// The rows of one column (render.h), blockIdx.y. A block copies kThreads rows, a thread one word at a
// time, so that neighbouring threads read neighbouring words.
__global__ void __launch_bounds__(kThreads) gather_rows_kernel(const __grid_constant__ GatherRows gather) {
  __shared__ int64_t rows[kThreads];
  const GatheredColumn& column = gather.columns[blockIdx.y];
  const int64_t first = blockIdx.x * int64_t{kThreads};
  const int64_t left = valid_splat_count(gather.n, gather.known) - first;
  if (left <= 0) return;
  const auto n = uint32_t(left < kThreads ? left : kThreads);
  if (threadIdx.x < n) rows[threadIdx.x] = gather.ids[first + threadIdx.x];
  __syncthreads();
  const uint32_t width = column.width;
  uint32_t* to = column.to + first * column.stride;
#pragma unroll 4
  for (uint32_t i = threadIdx.x; i < n * width; i += kThreads) {
    const uint32_t place = i / width, k = i - place * width;
    to[place * column.stride + k] = column.from[rows[place] * width + k];
  }
}

}  // namespace

void gather_rows(const GatherRows& gather, CudaStream stream) {
  if (gather.n == 0 || gather.n_columns == 0) return;
  const dim3 blocks(blocks_for(gather.n, kThreads), unsigned(gather.n_columns));
  gather_rows_kernel<<<blocks, kThreads, 0, stream>>>(gather);
  check_launch("gather_rows");
}

void zero_words(uint32_t* words, int64_t n, CudaStream stream) {
  if (n == 0) return;
  check(cudaMemsetAsync(words, 0, size_t(n) * sizeof(*words), stream), "arrange_splats");
}

template void for_each_row(const NumberedRows&, CudaStream);
template void for_each_row(const ArrangeSplats&, CudaStream);
template void for_each_row(const UnderSplats&, CudaStream);
template void for_each_row(const Alphas<float>&, CudaStream);

}  // namespace blitzgs::cuda
