// SPDX-License-Identifier: Apache-2.0
#include "adam/position_noise.h"
#include "common/cuda.cuh"
#include "common/rows.h"
#include "importance/view_sums.h"
#include "population/density_stats.h"
#include "population/spawn_features.h"
#include "population/voxel_keys.h"
#include "render/render.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// One thread per row.
template <class Rows>
__global__ void __launch_bounds__(kThreads) row_kernel(const __grid_constant__ Rows work) {
  wait_for_earlier_kernels();
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i < work.n) work(i);
}

}  // namespace

template <class Rows>
void for_each_row(const Rows& work, CudaStream stream) {
  if (work.n == 0) return;
  launch_early("rows", row_kernel<Rows>, {blocks_for(work.n, kThreads), kThreads, stream}, work);
}

template void for_each_row(const Alphas<float>&, CudaStream);
template void for_each_row(const DensityStats<float>&, CudaStream);
template void for_each_row(const PositionNoise<float>&, CudaStream);
template void for_each_row(const SpawnFeatures&, CudaStream);
template void for_each_row(const ViewSums&, CudaStream);
template void for_each_row(const VoxelKeys<float>&, CudaStream);

}  // namespace blitzgs::cuda
