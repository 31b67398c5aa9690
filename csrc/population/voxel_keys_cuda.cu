// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "population/voxel_keys.h"

namespace blitzgs::cuda {

namespace {
// keys [n] (voxel_keys.h), one thread per point.
template <class T>
__global__ void voxel_keys_kernel(const T* points, std::int64_t n, VoxelGrid grid, std::int64_t* keys) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i < n) keys[i] = voxel_key(points + 3 * i, grid);
}
}  // namespace

template <class T>
void voxel_keys(const T* points, std::int64_t n, const VoxelGrid& grid, std::int64_t* keys, Workspace&,
                CudaStream stream) {
  if (n == 0) return;
  voxel_keys_kernel<<<blocks_for(n, 256), 256, 0, stream>>>(points, n, grid, keys);
  check_launch("voxel_keys");
}

template void voxel_keys<float>(const float*, std::int64_t, const VoxelGrid&, std::int64_t*, Workspace&,
                                CudaStream);

}  // namespace blitzgs::cuda
