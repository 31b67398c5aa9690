// SPDX-License-Identifier: Apache-2.0
#include "adam/position_noise.h"
#include "common/parallel.h"
#include "common/rows.h"
#include "importance/view_sums.h"
#include "population/density_stats.h"
#include "population/spawn_features.h"
#include "population/voxel_keys.h"
#include "render/render.h"

namespace blitzgs::cpu {

template <class Rows>
void for_each_row(const Rows& work, CudaStream) {
  parallel_for(0, work.n, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) work(i);
  });
}

template void for_each_row(const Alphas<float>&, CudaStream);
template void for_each_row(const Alphas<double>&, CudaStream);
template void for_each_row(const DensityStats<float>&, CudaStream);
template void for_each_row(const DensityStats<double>&, CudaStream);
template void for_each_row(const PositionNoise<float>&, CudaStream);
template void for_each_row(const PositionNoise<double>&, CudaStream);
template void for_each_row(const SpawnFeatures&, CudaStream);
template void for_each_row(const ViewSums&, CudaStream);
template void for_each_row(const VoxelKeys<float>&, CudaStream);
template void for_each_row(const VoxelKeys<double>&, CudaStream);

}  // namespace blitzgs::cpu
