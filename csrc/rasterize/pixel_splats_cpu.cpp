// SPDX-License-Identifier: Apache-2.0
#include "rasterize/pixel_splats.h"

#include "rasterize/tile_jobs.h"

namespace blitzgs::cpu {

template <class T>
void pixel_splats(const RasterizeInput<T>& in, const PixelSplats<T>& out, Workspace& workspace, CudaStream) {
  const PreparedSplat<T>* splats = pack_splats(in, allocate_splats<T>(in.n_splats, workspace));
  const TileKernels<T> kernels = tile_kernels<T>(0, false);
  const TileMemory<T> memory(in, workspace);
  parallel_tasks(in.grid.count(), [&](std::int64_t tile, int worker) {
    TileJob<T> job = make_job(in, splats, tile);
    memory.lend(worker, &job);
    kernels.list_splats(job, out);
  });
}

template void pixel_splats<float>(const RasterizeInput<float>&, const PixelSplats<float>&, Workspace&,
                                  CudaStream);
template void pixel_splats<double>(const RasterizeInput<double>&, const PixelSplats<double>&, Workspace&,
                                   CudaStream);

}  // namespace blitzgs::cpu
