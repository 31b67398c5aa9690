// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <algorithm>

#include "rasterize/tile_jobs.h"

namespace blitzgs::cpu {

template <class T>
void contributions(const ContributionInput<T>& in, const ContributionSums& sums, Workspace& workspace,
                   CudaStream) {
  std::fill_n(sums.weights, in.n_splats, 0);
  std::fill_n(sums.pixels, in.n_splats, 0);
  if (sums.squares) std::fill_n(sums.squares, in.n_splats, 0);
  const RasterizeInput<T> input{in.means2d,      in.conics,       in.opacities, nullptr, nullptr,
                                in.isect_splats, in.tile_offsets, in.n_splats,  0,       in.grid};
  const PreparedSplat<T>* splats = pack_splats(input, allocate_splats<T>(in.n_splats, workspace));
  const TileKernels<T> kernels = tile_kernels<T>(0, false);
  const TileMemory<T> memory(input, workspace);
  parallel_tasks(in.grid.tile_end - in.grid.tile_begin, [&](std::int64_t task, int worker) {
    TileJob<T> job = make_job(input, splats, in.grid.tile_begin + task);
    memory.lend(worker, &job);
    kernels.contribute(job, sums);
  });
}

template void contributions<float>(const ContributionInput<float>&, const ContributionSums&, Workspace&,
                                   CudaStream);
template void contributions<double>(const ContributionInput<double>&, const ContributionSums&, Workspace&,
                                    CudaStream);

}  // namespace blitzgs::cpu
