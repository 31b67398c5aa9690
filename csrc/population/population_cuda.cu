// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "common/rows.cuh"
#include "population/density_stats.h"
#include "population/find_non_finite.h"
#include "population/spawn_features.h"
#include "population/tree_sums.h"

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

namespace {

// A row of features in shared memory. Feature i of all threads is contiguous, so lanes have no bank
// conflicts.
struct StridedRow {
  const float* first;
  __device__ float operator[](int feature) const { return first[feature * kThreads]; }
};

// sums [M] (tree_sums.h), one thread per row. All threads of a block take the same tree at a time, so that
// its nodes stay in the L1 cache.
__global__ void __launch_bounds__(kThreads) tree_sums_kernel(const TreeSumsArgs args) {
  extern __shared__ float shared[];
  wait_for_earlier_kernels();
  const std::int64_t row = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= args.n_rows) return;
  float* const row_features = shared + threadIdx.x;
  const float* const features = args.features + row * args.n_features;
  for (int i = 0; i < args.n_features; ++i) row_features[i * kThreads] = features[i];
  args.sums[row] = tree_sum_of(args, StridedRow{row_features});
}

}  // namespace

void tree_sums(const TreeSumsArgs& args, CudaStream stream) {
  if (args.n_rows == 0) return;
  const std::size_t bytes = args.n_features * kThreads * sizeof(float);
  launch_early("tree_sums", tree_sums_kernel, {blocks_for(args.n_rows, kThreads), kThreads, stream, bytes},
               args);
}

template void for_each_row(const DensityStats<float>&, CudaStream);
template void for_each_row(const SpawnFeatures&, CudaStream);

}  // namespace blitzgs::cuda
