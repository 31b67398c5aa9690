// SPDX-License-Identifier: Apache-2.0
#include "common/cuda_check.h"
#include "route/route.h"

namespace blitzgs::cuda {

namespace {

using Counter = unsigned long long;

template <class T>
__global__ void route_count_kernel(RouteInput<T> in, std::int64_t* masks, Counter* counts) {
  __shared__ Counter local[2 * kMaxRanks];
  const int n_counts = 2 * in.ranks.n_ranks;
  for (int i = threadIdx.x; i < n_counts; i += blockDim.x) local[i] = 0;
  __syncthreads();
  const std::int64_t row = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  std::int64_t mask = 0;
  if (row < in.n_rows) {
    mask = route_row(in, row, [&](int m, std::int64_t tiles) {
      atomicAdd(&local[2 * m + 1], static_cast<Counter>(tiles));
    });
    masks[row] = mask;
  }
  // One add per warp and rank for the row counts.
  for (int m = 0; m < in.ranks.n_ranks; ++m) {
    const unsigned going = __ballot_sync(0xffffffffu, (mask >> m) & 1);
    if (threadIdx.x % 32 == 0 && going) atomicAdd(&local[2 * m], static_cast<Counter>(__popc(going)));
  }
  __syncthreads();
  for (int i = threadIdx.x; i < n_counts; i += blockDim.x) {
    if (local[i]) atomicAdd(&counts[i], local[i]);
  }
}

}  // namespace

template <class T>
void route_count(const RouteInput<T>& in, std::int64_t* masks, std::int64_t* counts, Workspace&,
                 CudaStream stream) {
  check(cudaMemsetAsync(counts, 0, 2 * in.ranks.n_ranks * sizeof(std::int64_t), stream), "route_count");
  if (in.n_rows == 0) return;
  route_count_kernel<<<blocks_for(in.n_rows, 256), 256, 0, stream>>>(in, masks,
                                                                     reinterpret_cast<Counter*>(counts));
  check_launch("route_count");
}

template void route_count<float>(const RouteInput<float>&, std::int64_t*, std::int64_t*, Workspace&,
                                 CudaStream);

}  // namespace blitzgs::cuda
