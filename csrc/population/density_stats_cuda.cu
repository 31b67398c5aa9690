// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "population/density_stats.h"

namespace blitzgs::cuda {

namespace {
// Updates the statistics (density_stats.h), one thread per visible Gaussian.
template <class T>
__global__ void density_stats_kernel(const DensityStatsArgs<T> args) {
  const std::int64_t u = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (u < args.visible) density_stats_of(args, u);
}
}  // namespace

template <class T>
void density_stats(const DensityStatsArgs<T>& args, Workspace&, CudaStream stream) {
  if (args.visible == 0) return;
  density_stats_kernel<<<blocks_for(args.visible, 256), 256, 0, stream>>>(args);
  check_launch("density_stats");
}

template void density_stats<float>(const DensityStatsArgs<float>&, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
