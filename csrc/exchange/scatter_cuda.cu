// SPDX-License-Identifier: Apache-2.0
#include "exchange/scatter_device.cuh"

namespace blitzgs::cuda {
namespace {

// The values of a splat that a thread sums: all 9 of a splat with three colour channels, or up to 16 of more.
constexpr int kSplatValues = 9, kPartValues = 16;
constexpr int kSumThreads = 256;

constexpr int kFewRanks = 8;  // enough for most hosts, with less shared memory than kMaxRanks

// The scatter of splats (scatter.h), one block per kScatterBlock splats, one thread per splat. RANKS: an
// upper bound on the number of ranks.
template <int RANKS>
__global__ void __launch_bounds__(kScatterBlock)
    scatter_kernel(const __grid_constant__ ScatterSplats splats, const __grid_constant__ SplatGroups groups,
                   const __grid_constant__ ScatterTargets targets, const ScatterState state) {
  // One struct, so that the addresses of all its arrays come from one register.
  __shared__ struct {
    uint8_t lists[RANKS][kScatterBlock];  // the block's splats that go to each rank, ascending
    int before[RANKS][kScatterWarps];     // how many of them come before each warp
    int counts[RANKS], bases[RANKS];      // those that fit the group, and the first one's position
  } block;
  const int n_ranks = groups.count, slot = threadIdx.x, warp = slot / 32, lane = slot % 32;
  const SplatColumns<const int32_t>& columns = splats.columns;
  const int64_t first = blockIdx.x * int64_t(kScatterBlock);
  const int64_t mask = first + slot < splats.count ? splats.masks[first + slot] : 0;
  for (int m = 0; m < n_ranks; ++m) {
    const unsigned going = __ballot_sync(kFullWarp, (mask >> m) & 1);
    if (lane == 0) block.before[m][warp] = __popc(going);
  }
  __syncthreads();
  if (slot < n_ranks) {
    int sum = 0;
#pragma unroll
    for (int& splats_of_warp : block.before[slot]) {
      const int count = splats_of_warp;
      splats_of_warp = sum;
      sum += count;
    }
    const int64_t base = state.take(slot, sum), left = groups.size[slot] - base;
    block.bases[slot] = int(base);
    block.counts[slot] = left >= sum ? sum : left > 0 ? int(left) : 0;
  }
  __syncthreads();
  for (int m = 0; m < n_ranks; ++m) {
    const bool goes = (mask >> m) & 1;
    const unsigned going = __ballot_sync(kFullWarp, goes);
    const int before = block.before[m][warp];
    if (goes) block.lists[m][before + __popc(going & ((1u << lane) - 1u))] = uint8_t(slot);
    if (lane == 0 && first + slot < splats.count) {
      state.places[(first + slot) / kPlaceSplats * n_ranks + m] = {block.bases[m] + before, going};
    }
  }
  __syncthreads();
  for (int run = warp; run < n_ranks * columns.count; run += kScatterWarps) {
    const int m = run / columns.count, c = run - m * columns.count;
    const int width = columns.begin[c + 1] - columns.begin[c];
    copy_run(columns.data[c] + first * width, block.lists[m], block.counts[m], width,
             targets.words[m][c] + int64_t{block.bases[m]} * width);
  }
}

// The gather of splats (scatter.h): block (x, y) copies a part of column y % columns.count of group
// y / columns.count, one thread per word.
__global__ void gather_kernel(const int32_t* packed, const __grid_constant__ SplatGroups groups,
                              const SplatColumns<int32_t> columns) {
  const int m = blockIdx.y / columns.count, c = blockIdx.y % columns.count;
  const int64_t width = columns.begin[c + 1] - columns.begin[c];
  const int32_t* from =
      packed + groups.start[m] * columns.begin[columns.count] + groups.size[m] * columns.begin[c];
  int32_t* to = columns.data[c] + groups.start[m] * width;
  const int64_t n = groups.size[m] * width, step = int64_t(gridDim.x) * blockDim.x;
  for (int64_t i = blockIdx.x * int64_t(blockDim.x) + threadIdx.x; i < n; i += step) to[i] = from[i];
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
  const int value = ALL ? 0 : VALUES * int(blockIdx.y);
  const int n_values = ALL ? VALUES : min(VALUES, in.width - value);
  const int64_t first = blockIdx.x * int64_t(kSumThreads);
  const int64_t splat = first + threadIdx.x;
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
  const int64_t left = in.count - first;
  const int n_splats = left < kSumThreads ? int(left) : kSumThreads;
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
  const int64_t splat = blockIdx.x * int64_t{kGradientSplats} + threadIdx.x / kGradientPieces;
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
  auto* filled = workspace.allocate<int64_t>(groups.count);
  check(cudaMemsetAsync(filled, 0, groups.count * sizeof(*filled), stream), "scatter_splats");
  const auto kernel = groups.count <= kFewRanks ? scatter_kernel<kFewRanks> : scatter_kernel<kMaxRanks>;
  kernel<<<blocks_for(splats.count, kScatterBlock), kScatterBlock, 0, stream>>>(splats, groups, targets,
                                                                                ScatterState{filled, places});
  check_launch("scatter_splats");
}

void gather(const int32_t* packed, const SplatGroups& groups, const SplatColumns<int32_t>& columns,
            CudaStream stream) {
  const int64_t most = *std::max_element(groups.size, groups.size + groups.count);
  if (most == 0) return;
  const dim3 grid(std::min(1024u, blocks_for(most, 256)), groups.count * columns.count);
  gather_kernel<<<grid, 256, 0, stream>>>(packed, groups, columns);
  check_launch("gather_splats");
}

template <> void sum<float>(const SplatValues<float>& in, const SplatColumns<float>& out, CudaStream stream) {
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
