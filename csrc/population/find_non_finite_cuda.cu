// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "population/find_non_finite.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256, kBlocks = 512;

// Each block takes a part of the column blockIdx.y.
__global__ void __launch_bounds__(kThreads)
    check_columns_kernel(const __grid_constant__ CheckedColumns<float> checked) {
  const auto& column = checked.columns[blockIdx.y];
  bool bad = false;
  for (std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x; i < column.length;
       i += gridDim.x * std::int64_t{kThreads}) {
    bad |= is_bad(column.values[i], column.zero_is_bad);
  }
  if (bad) *checked.bad = 1;
}

}  // namespace

void clear_flag(std::int32_t* bad, CudaStream stream) {
  check(cudaMemsetAsync(bad, 0, sizeof(*bad), stream), "find_non_finite");
}

template <>
void check_columns<float>(const CheckedColumns<float>& checked, CudaStream stream) {
  if (checked.n == 0) return;
  check_columns_kernel<<<dim3(kBlocks, static_cast<unsigned>(checked.n)), kThreads, 0, stream>>>(checked);
  check_launch("find_non_finite");
}

}  // namespace blitzgs::cuda
