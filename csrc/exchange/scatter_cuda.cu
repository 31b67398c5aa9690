// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/cuda.cuh"
#include "exchange/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

// The values of a splat that a thread sums: all 9 of a splat with three colour channels, or up to 16 of more.
constexpr int kSplatValues = 9, kPartValues = 16;
constexpr int kSumThreads = 256;

// The scatter of splats (scatter.h), one block per kScatterBlock splats (scatter_device.cuh).
template <int RANKS>
__global__ void __launch_bounds__(kScatterBlock)
    scatter_kernel(const __grid_constant__ ScatterSplats splats, const __grid_constant__ SplatGroups groups,
                   const __grid_constant__ ScatterTargets targets, const ScatterState state) {
  __shared__ ScatterShared<RANKS> shared;
  scatter_block<kScatterBlock>(shared, splats, splats.count, {groups.size, groups.count}, targets, state);
}

// The gather of splats (scatter.h): block (x, y) copies a part of column y % columns.count of group
// y / columns.count, one thread per word.
__global__ void gather_kernel(const std::int32_t* packed, const __grid_constant__ SplatGroups groups,
                              const SplatColumns<std::int32_t> columns) {
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

// Writes `any_part` values of each splat from shared memory (PITCH floats per splat) to columns with
// `any_width` values per splat. WIDTH: the value of both if it is known at compile time, or 0.
template <int PITCH, int WIDTH>
__device__ __forceinline__ void store_values(const float* from, int n_splats, int any_part, int any_width,
                                             float* to) {
  const int part = WIDTH > 0 ? WIDTH : any_part, width = WIDTH > 0 ? WIDTH : any_width;
  for (int i = threadIdx.x; i < n_splats * part; i += kSumThreads) {
    const int splat = i / part, k = i - splat * part;
    to[splat * width + k] = from[splat * PITCH + k];
  }
}

// The sum over ranks (scatter.h). One thread per splat; the blocks of grid row y sum the values from
// VALUES * blockIdx.y on, at most VALUES of them. ALL: each splat has exactly VALUES values.
template <int VALUES, bool ALL>
__global__ void __launch_bounds__(kSumThreads) sum_kernel(const __grid_constant__ SplatValues<float> in,
                                                          const __grid_constant__ SplatColumns<float> out) {
  constexpr int kPitch = VALUES | 1;  // odd: the same value of different splats lies in different banks
  __shared__ float sums[kSumThreads * kPitch];
  const int value = ALL ? 0 : VALUES * static_cast<int>(blockIdx.y);
  const int n_values = ALL ? VALUES : min(VALUES, in.width - value);
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kSumThreads);
  const std::int64_t splat = first + threadIdx.x;
  float sum[VALUES] = {};
  if (splat < in.count) {
    in.for_each(splat, [&](const float* from) {
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
  const int n_splats = left < kSumThreads ? static_cast<int>(left) : kSumThreads;
  for (int c = 0; c < out.count; ++c) {
    const int low = max(out.begin[c], value), high = min(out.begin[c + 1], value + n_values);
    const int part = high - low, width = out.begin[c + 1] - out.begin[c];
    if (part <= 0) continue;
    float* to = out.data[c] + first * width + (low - out.begin[c]);
    const float* from = sums + (low - value);
    if (part == width && width == 3) {
      store_values<kPitch, 3>(from, n_splats, part, width, to);
    } else if (part == width && width == 2) {
      store_values<kPitch, 2>(from, n_splats, part, width, to);
    } else if (part == width && width == 1) {
      store_values<kPitch, 1>(from, n_splats, part, width, to);
    } else {
      store_values<kPitch, 0>(from, n_splats, part, width, to);
    }
  }
}

// The same for values that are SplatGradients, to one column of them: one thread per 16 bytes, so that a warp
// reads whole lines, which may be in the memory of another GPU.
constexpr int kGradientPieces = kSplatGradient / 4, kGradientSplats = 128;

__global__ void __launch_bounds__(kGradientPieces* kGradientSplats)
    sum_gradients_kernel(const __grid_constant__ SplatValues<float> in, float4* out) {
  const int piece = threadIdx.x % kGradientPieces;
  const std::int64_t splat = blockIdx.x * std::int64_t{kGradientSplats} + threadIdx.x / kGradientPieces;
  if (splat >= in.count) return;
  float4 sum{};
  in.for_each(splat, [&](const float* from) {
    const float4 v = reinterpret_cast<const float4*>(from)[piece];
    sum = {sum.x + v.x, sum.y + v.y, sum.z + v.z, sum.w + v.w};
  });
  out[splat * kGradientPieces + piece] = sum;
}

bool are_gradients(const SplatValues<float>& in, const SplatColumns<float>& out) {
  const auto aligned = [](const float* p) { return reinterpret_cast<std::uintptr_t>(p) % 16 == 0; };
  return in.width == kSplatGradient && out.count == 1 && aligned(out.data[0]) &&
         std::all_of(in.values, in.values + in.n_ranks, aligned);
}

}  // namespace

void scatter(const ScatterSplats& splats, const SplatGroups& groups, const ScatterTargets& targets,
             SplatPlace* places, Workspace& workspace, CudaStream stream) {
  if (splats.count == 0) return;
  auto* filled = workspace.allocate<std::int64_t>(groups.count);
  check(cudaMemsetAsync(filled, 0, groups.count * sizeof(*filled), stream), "scatter_splats");
  dispatch_ranks(groups.count, [&](auto ranks) {
    scatter_kernel<ranks.value>
        <<<static_cast<unsigned>(scatter_blocks(splats.count)), kScatterBlock, 0, stream>>>(
            splats, groups, targets, ScatterState{filled, places});
  });
  check_launch("scatter_splats");
}

void gather(const std::int32_t* packed, const SplatGroups& groups, const SplatColumns<std::int32_t>& columns,
            CudaStream stream) {
  const std::int64_t most = *std::max_element(groups.size, groups.size + groups.count);
  if (most == 0) return;
  const dim3 grid(std::min(1024u, blocks_for(most, 256)), groups.count * columns.count);
  gather_kernel<<<grid, 256, 0, stream>>>(packed, groups, columns);
  check_launch("gather_splats");
}

template <>
void sum<float>(const SplatValues<float>& in, const SplatColumns<float>& out, CudaStream stream) {
  if (in.count == 0 || in.width == 0) return;
  if (are_gradients(in, out)) {
    sum_gradients_kernel<<<blocks_for(in.count, kGradientSplats), kGradientPieces * kGradientSplats, 0,
                           stream>>>(in, reinterpret_cast<float4*>(out.data[0]));
    check_launch("sum_splats");
    return;
  }
  const unsigned blocks = blocks_for(in.count, kSumThreads);
  if (in.width == kSplatValues) {
    sum_kernel<kSplatValues, true><<<blocks, kSumThreads, 0, stream>>>(in, out);
  } else {
    const dim3 grid(blocks, blocks_for(in.width, kPartValues));
    sum_kernel<kPartValues, false><<<grid, kSumThreads, 0, stream>>>(in, out);
  }
  check_launch("sum_splats");
}

}  // namespace blitzgs::cuda
