// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/cuda_check.h"
#include "scatter/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

// Values of a row that a thread adds up at once: those of three colours, or a part of more.
constexpr int kRowValues = 9, kPartValues = 16;
constexpr int kSumThreads = 256;

template <int RANKS>
__global__ void __launch_bounds__(kScatterBlock)
    scatter_kernel(const __grid_constant__ ScatterRows rows, const __grid_constant__ RowGroups groups,
                   const __grid_constant__ ScatterTargets targets, const ScatterState state) {
  __shared__ ScatterShared<RANKS> shared;
  scatter_block<kScatterBlock>(shared, rows, rows.count, {groups.size, groups.count}, targets, state);
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

// Stores `part` values of each row, PITCH apart in shared memory, into rows of `width`. WIDTH: both, or 0.
template <int PITCH, int WIDTH>
__device__ __forceinline__ void store_values(const float* from, int n_rows, int any_part, int any_width,
                                             float* to) {
  const int part = WIDTH > 0 ? WIDTH : any_part, width = WIDTH > 0 ? WIDTH : any_width;
  for (int i = threadIdx.x; i < n_rows * part; i += kSumThreads) {
    const int row = i / part, k = i - row * part;
    to[row * width + k] = from[row * PITCH + k];
  }
}

// Values [VALUES * blockIdx.y, ...) of a block of rows. ALL: the rows have VALUES.
template <int VALUES, bool ALL>
__global__ void __launch_bounds__(kSumThreads)
    sum_kernel(const __grid_constant__ RowValues<float> in, const __grid_constant__ RowColumns<float> out) {
  constexpr int kPitch = VALUES | 1;  // odd, so that a column of rows spreads over the banks
  __shared__ float sums[kSumThreads * kPitch];
  const int value = ALL ? 0 : VALUES * static_cast<int>(blockIdx.y);
  const int n_values = ALL ? VALUES : min(VALUES, in.width - value);
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kSumThreads);
  const std::int64_t row = first + threadIdx.x;
  float sum[VALUES] = {};
  if (row < in.count) {
    in.for_each(row, [&](const float* from) {
#pragma unroll
      for (int k = 0; k < VALUES; ++k) {
        if (k < n_values) sum[k] += from[value + k];
      }
    });
  }
#pragma unroll
  for (int k = 0; k < VALUES; ++k) sums[threadIdx.x * kPitch + k] = sum[k];
  __syncthreads();
  const std::int64_t left = in.count - first;
  const int n_rows = left < kSumThreads ? static_cast<int>(left) : kSumThreads;
  for (int c = 0; c < out.count; ++c) {
    const int low = max(out.begin[c], value), high = min(out.begin[c + 1], value + n_values);
    const int part = high - low, width = out.begin[c + 1] - out.begin[c];
    if (part <= 0) continue;
    float* to = out.data[c] + first * width + (low - out.begin[c]);
    const float* from = sums + (low - value);
    if (part == width && width == 3) {
      store_values<kPitch, 3>(from, n_rows, part, width, to);
    } else if (part == width && width == 2) {
      store_values<kPitch, 2>(from, n_rows, part, width, to);
    } else if (part == width && width == 1) {
      store_values<kPitch, 1>(from, n_rows, part, width, to);
    } else {
      store_values<kPitch, 0>(from, n_rows, part, width, to);
    }
  }
}

}  // namespace

void scatter(const ScatterRows& rows, const RowGroups& groups, const ScatterTargets& targets,
             RowPlace* places, Workspace& workspace, CudaStream stream) {
  if (rows.count == 0) return;
  auto* filled = workspace.allocate<std::int64_t>(groups.count);
  check(cudaMemsetAsync(filled, 0, groups.count * sizeof(*filled), stream), "scatter_rows");
  dispatch_ranks(groups.count, [&](auto ranks) {
    scatter_kernel<ranks.value>
        <<<static_cast<unsigned>(scatter_blocks(rows.count)), kScatterBlock, 0, stream>>>(
            rows, groups, targets, ScatterState{filled, places});
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
void sum<float>(const RowValues<float>& in, const RowColumns<float>& out, Workspace&, CudaStream stream) {
  if (in.count == 0 || in.width == 0) return;
  const unsigned blocks = blocks_for(in.count, kSumThreads);
  if (in.width == kRowValues) {
    sum_kernel<kRowValues, true><<<blocks, kSumThreads, 0, stream>>>(in, out);
  } else {
    const dim3 grid(blocks, blocks_for(in.width, kPartValues));
    sum_kernel<kPartValues, false><<<grid, kSumThreads, 0, stream>>>(in, out);
  }
  check_launch("sum_rows");
}

}  // namespace blitzgs::cuda
