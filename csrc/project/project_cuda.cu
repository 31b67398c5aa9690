// SPDX-License-Identifier: Apache-2.0
#include "project/prefilter.cuh"

namespace blitzgs::cuda {

template <>
void project<float>(const Inputs& in, const RankTiles& rank_tiles, SplatMemory<float>& memory,
                    std::int64_t* totals, Workspace& workspace, CudaStream stream) {
  const Prefiltered kept(in.n_candidates, workspace);
  prefilter(in, kept, workspace, stream);
  if (const ProjectSizes* capacity = memory.capacity()) {
    const ProjectColumns<float> columns = memory.allocate(*capacity);
    write_splats(in, rank_tiles, kept, *capacity, columns, totals, workspace, stream);
    write_colors(in, {*capacity, totals}, columns, stream);
    return;
  }
  write_splats(in, rank_tiles, kept, {0, 0}, {}, totals, workspace, stream);
  std::int64_t counted[kTotalSplats + 1];
  check(cudaMemcpyAsync(counted, totals, sizeof(counted), cudaMemcpyDeviceToHost, stream), "project");
  check(cudaStreamSynchronize(stream), "project");
  const ProjectSizes sizes{counted[kTotalVisible], counted[kTotalSplats]};
  const ProjectColumns<float> columns = memory.allocate(sizes);
  write_splats(in, rank_tiles, kept, sizes, columns, nullptr, workspace, stream);
  write_colors(in, {sizes, nullptr}, columns, stream);
}

}  // namespace blitzgs::cuda
