// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "render/arrange_splats.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// One thread per entry.
__global__ void __launch_bounds__(kThreads) fill_entries_kernel(const EmptyEntries fill) {
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i >= fill.entries) return;
  const std::int64_t words = fill.column.words, source = fill.source(i);
  for (std::int64_t k = 0; k < words; ++k) fill.column.to[i * words + k] = fill.under[source * words + k];
}

// One thread per splat, which copies its row of every column.
__global__ void __launch_bounds__(kThreads) arrange_splats_kernel(const ArrangeSplats moves, bool back) {
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i >= moves.n) return;
  const std::int64_t splat = moves.splat(i), entry = moves.entry(i);
  const std::int64_t from = back ? entry : splat, to = back ? splat : entry;
  for (int c = 0; c < moves.n_columns; ++c) {
    const ArrangedColumn& column = moves.columns[c];
    const std::uint32_t* source = column.from + from * column.stride;
    std::uint32_t* target = column.to + to * column.words;
    for (std::int64_t k = 0; k < column.words; ++k) target[k] = source[k];
  }
}

}  // namespace

void fill_entries(const EmptyEntries& fill, CudaStream stream) {
  const std::int64_t words = fill.entries * fill.column.words;
  if (words == 0) return;
  if (!fill.under) {
    check(cudaMemsetAsync(fill.column.to, 0, static_cast<std::size_t>(words) * sizeof(std::uint32_t), stream),
          "fill_entries");
    return;
  }
  fill_entries_kernel<<<blocks_for(fill.entries, kThreads), kThreads, 0, stream>>>(fill);
  check_launch("fill_entries");
}

void arrange_splats(const ArrangeSplats& moves, bool back, CudaStream stream) {
  if (moves.n == 0 || moves.n_columns == 0) return;
  arrange_splats_kernel<<<blocks_for(moves.n, kThreads), kThreads, 0, stream>>>(moves, back);
  check_launch("arrange_splats");
}

}  // namespace blitzgs::cuda
