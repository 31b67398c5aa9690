// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "population/density_stats.h"

namespace blitzgs::cpu {

template <class T>
void density_stats(const DensityStatsArgs<T>& args, Workspace&, CudaStream) {
  parallel_for(0, args.visible, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t u = begin; u < end; ++u) density_stats_of(args, u);
  });
}

template void density_stats<float>(const DensityStatsArgs<float>&, Workspace&, CudaStream);
template void density_stats<double>(const DensityStatsArgs<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
