// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/cuda_check.h"
#include "scatter/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

// Values of a row that a thread adds up at once: those of three colours, or a part of more.
constexpr int kRowValues = 9, kPartValues = 16;

template <int RANKS>
__global__ void __launch_bounds__(kScatterBlock)
    scatter_kernel(const __grid_constant__ ScatterRows rows, const __grid_constant__ RowGroups groups,
                   const __grid_constant__ ScatterTargets targets, const ScatterState state) {
  __shared__ ScatterShared<RANKS> shared;
  scatter_block<kScatterBlock>(shared, rows, groups, targets, state);
}

// Block (x, y) copies a part of column y % count of group y / count.
__global__ void gather_kernel(const std::int32_t* packed, const __grid_constant__ RowGroups groups,
                              const RowColumns<std::int32_t> columns) {
  const int m = blockIdx.y / columns.count, c = blockIdx.y % columns.count;
  const std::int64_t width = columns.begin[c + 1] - columns.begin[c];
  const std::int32_t* from =
      packed + groups.start[m] * columns.begin[columns.count] + groups.size[m] * columns.begin[c];
  std::int32_t* to = columns.data[c] + groups.start[m] * width;
  const std::int64_t n = groups.size[m] * width, step = static_cast<std::int64_t>(gridDim.x) * blockDim.x;
  for (std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x; i < n; i += step) {
    to[i] = from[i];
  }
}

template <int RANKS, int VALUES>
struct SumShared {
  static constexpr int kPitch = VALUES | 1;  // odd, so that a column of rows spreads over the banks
  std::uint8_t place[RANKS][kScatterBlock];  // of each thread's row among the block's rows for a rank
  int before[RANKS][kScatterWarps];
  std::int32_t base[RANKS];
  float sums[kScatterBlock * kPitch];
};

// Stores `part` values of each row, PITCH apart in shared memory, into rows of `width`. WIDTH: both, or 0.
template <int PITCH, int WIDTH>
__device__ __forceinline__ void store_values(const float* from, int n_rows, int any_part, int any_width,
                                             float* to) {
  const int part = WIDTH > 0 ? WIDTH : any_part, width = WIDTH > 0 ? WIDTH : any_width;
  for (int i = threadIdx.x; i < n_rows * part; i += kScatterBlock) {
    const int row = i / part, k = i - row * part;
    to[row * width + k] = from[row * PITCH + k];
  }
}

// Values [VALUES * blockIdx.y, ...) of a block of rows. ALL: the rows have VALUES.
template <int RANKS, int VALUES, bool ALL>
__global__ void __launch_bounds__(kScatterBlock) sum_kernel(const __grid_constant__ ReturnedRows<float> in,
                                                            const __grid_constant__ RowColumns<float> out) {
  using Shared = SumShared<RANKS, VALUES>;
  __shared__ Shared shared;
  const int n_ranks = in.groups.count, width_in = ALL ? VALUES : in.width;
  const int value = ALL ? 0 : VALUES * static_cast<int>(blockIdx.y);
  const int n_values = ALL ? VALUES : min(VALUES, width_in - value);
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kScatterBlock);
  const std::int64_t row = first + threadIdx.x;
  const std::int64_t mask = row < in.count ? in.masks[row] : 0;
  if (static_cast<int>(threadIdx.x) < n_ranks) {
    shared.base[threadIdx.x] = in.bases[blockIdx.x * static_cast<std::int64_t>(n_ranks) + threadIdx.x];
  }
  const int slot = threadIdx.x;
  count_by_warp(shared.before, slot, mask, n_ranks);
  __syncthreads();
  if (slot < n_ranks) scan_warps(shared.before[slot]);
  __syncthreads();
  for (int m = 0; m < n_ranks; ++m) {
    const unsigned going = __ballot_sync(0xffffffffu, (mask >> m) & 1);
    shared.place[m][slot] = static_cast<std::uint8_t>(place_in_block(shared.before[m], slot, going));
  }
  // Most rows went to a single rank: this way all threads load their first at once.
  float sum[VALUES] = {};
  for (std::int64_t left = mask; left; left &= left - 1) {
    const int m = __ffsll(left) - 1;
    const std::int64_t at = std::int64_t{shared.base[m]} + shared.place[m][slot];
    if (at >= in.groups.size[m]) continue;
    const float* from = in.values + (in.groups.start[m] + at) * width_in + value;
#pragma unroll
    for (int k = 0; k < VALUES; ++k) {
      if (k < n_values) sum[k] += from[k];
    }
  }
#pragma unroll
  for (int k = 0; k < VALUES; ++k) shared.sums[slot * Shared::kPitch + k] = sum[k];
  __syncthreads();
  const std::int64_t left = in.count - first;
  const int n_rows = left < kScatterBlock ? static_cast<int>(left) : kScatterBlock;
  for (int c = 0; c < out.count; ++c) {
    const int low = max(out.begin[c], value), high = min(out.begin[c + 1], value + n_values);
    const int part = high - low, width = out.begin[c + 1] - out.begin[c];
    if (part <= 0) continue;
    float* to = out.data[c] + first * width + (low - out.begin[c]);
    const float* from = shared.sums + (low - value);
    if (part == width && width == 3) {
      store_values<Shared::kPitch, 3>(from, n_rows, part, width, to);
    } else if (part == width && width == 2) {
      store_values<Shared::kPitch, 2>(from, n_rows, part, width, to);
    } else if (part == width && width == 1) {
      store_values<Shared::kPitch, 1>(from, n_rows, part, width, to);
    } else {
      store_values<Shared::kPitch, 0>(from, n_rows, part, width, to);
    }
  }
}

}  // namespace

void scatter(const ScatterRows& rows, const RowGroups& groups, const ScatterTargets& targets,
             std::int32_t* bases, Workspace& workspace, CudaStream stream) {
  if (rows.count == 0) return;
  auto* filled = workspace.allocate<std::int32_t>(groups.count);
  check(cudaMemsetAsync(filled, 0, groups.count * sizeof(*filled), stream), "scatter_rows");
  dispatch_ranks(groups.count, [&](auto ranks) {
    scatter_kernel<ranks.value>
        <<<static_cast<unsigned>(scatter_blocks(rows.count)), kScatterBlock, 0, stream>>>(
            rows, groups, targets, ScatterState{filled, bases});
  });
  check_launch("scatter_rows");
}

void gather(const std::int32_t* packed, const RowGroups& groups, const RowColumns<std::int32_t>& columns,
            Workspace&, CudaStream stream) {
  const std::int64_t most = *std::max_element(groups.size, groups.size + groups.count);
  if (most == 0) return;
  const dim3 grid(std::min(1024u, blocks_for(most, 256)), groups.count * columns.count);
  gather_kernel<<<grid, 256, 0, stream>>>(packed, groups, columns);
  check_launch("gather_rows");
}

template <>
void sum<float>(const ReturnedRows<float>& in, const RowColumns<float>& out, Workspace&, CudaStream stream) {
  if (in.count == 0 || in.width == 0) return;
  const auto blocks = static_cast<unsigned>(scatter_blocks(in.count));
  dispatch_ranks(in.groups.count, [&](auto ranks) {
    if (in.width == kRowValues) {
      sum_kernel<ranks.value, kRowValues, true><<<blocks, kScatterBlock, 0, stream>>>(in, out);
    } else {
      const dim3 grid(blocks, blocks_for(in.width, kPartValues));
      sum_kernel<ranks.value, kPartValues, false><<<grid, kScatterBlock, 0, stream>>>(in, out);
    }
  });
  check_launch("sum_rows");
}

}  // namespace blitzgs::cuda
