// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "population/voxel_keys.h"

namespace blitzgs::cpu {

template <class T>
void voxel_keys(const T* points, std::int64_t n, const VoxelGrid& grid, std::int64_t* keys, Workspace&,
                CudaStream) {
  parallel_for(0, n, 1 << 14, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) keys[i] = voxel_key(points + 3 * i, grid);
  });
}

template void voxel_keys<float>(const float*, std::int64_t, const VoxelGrid&, std::int64_t*, Workspace&,
                                CudaStream);
template void voxel_keys<double>(const double*, std::int64_t, const VoxelGrid&, std::int64_t*, Workspace&,
                                 CudaStream);

}  // namespace blitzgs::cpu
