// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <mutex>

#include "common/parallel.h"
#include "route/route.h"

namespace blitzgs::cpu {

template <class T>
void route_count(const RouteInput<T>& in, std::int64_t* masks, std::int64_t* counts, Workspace&, CudaStream) {
  const int n_ranks = in.ranks.n_ranks;
  std::fill(counts, counts + 2 * n_ranks, 0);
  std::mutex adding;
  parallel_for(0, in.n_rows, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    std::int64_t local[2 * kMaxRanks] = {};
    for (std::int64_t row = begin; row < end; ++row) {
      masks[row] = route_row(in, row, [&](int m, std::int64_t tiles) { local[2 * m + 1] += tiles; });
      for (int m = 0; m < n_ranks; ++m) local[2 * m] += (masks[row] >> m) & 1;
    }
    const std::lock_guard<std::mutex> lock(adding);
    for (int i = 0; i < 2 * n_ranks; ++i) counts[i] += local[i];
  });
}

template void route_count<float>(const RouteInput<float>&, std::int64_t*, std::int64_t*, Workspace&,
                                 CudaStream);
template void route_count<double>(const RouteInput<double>&, std::int64_t*, std::int64_t*, Workspace&,
                                  CudaStream);

}  // namespace blitzgs::cpu
