// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "common/rows.h"
#include "project/project_device.cuh"
#include "render/render.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// The rows of one column (render.h), blockIdx.y. A block copies kThreads rows, a thread one word at a
// time, so that neighbouring threads read neighbouring words.
__global__ void __launch_bounds__(kThreads) gather_rows_kernel(const __grid_constant__ GatherRows gather) {
  __shared__ std::int64_t rows[kThreads];
  const GatheredColumn& column = gather.columns[blockIdx.y];
  const std::int64_t first = blockIdx.x * std::int64_t{kThreads};
  const std::int64_t left = valid_splat_count(gather.n, gather.known) - first;
  if (left <= 0) return;
  const auto n = static_cast<std::uint32_t>(left < kThreads ? left : kThreads);
  if (threadIdx.x < n) {
    const std::int64_t i = first + threadIdx.x;
    rows[threadIdx.x] = gather.ids ? gather.ids[i] : i;
  }
  __syncthreads();
  const std::uint32_t width = column.width;
  std::uint32_t* to = column.to + first * column.stride;
#pragma unroll 4
  for (std::uint32_t i = threadIdx.x; i < n * width; i += kThreads) {
    const std::uint32_t place = i / width, k = i - place * width;
    to[place * column.stride + k] = column.from[rows[place] * column.from_stride + k];
  }
}

// One thread per row.
__global__ void __launch_bounds__(kThreads)
    number_rows_kernel(const NumberedRows numbered, const ProjectCapacity capacity) {
  const std::int64_t u = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (u < fitting(capacity).visible) number_row(numbered, static_cast<std::int32_t>(u));
}

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

void gather_rows(const GatherRows& gather, CudaStream stream) {
  if (gather.n == 0 || gather.n_columns == 0) return;
  const dim3 blocks(blocks_for(gather.n, kThreads), static_cast<unsigned>(gather.n_columns));
  gather_rows_kernel<<<blocks, kThreads, 0, stream>>>(gather);
  check_launch("gather_rows");
}

void number_rows(const NumberedRows& numbered, const ProjectCapacity& capacity, CudaStream stream) {
  if (capacity.sizes.visible == 0) return;
  number_rows_kernel<<<blocks_for(capacity.sizes.visible, kThreads), kThreads, 0, stream>>>(numbered,
                                                                                            capacity);
  check_launch("color_rows");
}

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

template void for_each_row(const Alphas<float>&, CudaStream);

}  // namespace blitzgs::cuda
