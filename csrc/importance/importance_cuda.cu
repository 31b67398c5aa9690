// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <string>

#include "common/cuda.cuh"
#include "rasterize/forward.cuh"

namespace blitzgs::cuda {

namespace {

// A half-warp gathers what its pixels say of this many entries; then each lane adds one entry up.
constexpr int kGroup = 16;
constexpr int kEntryStride =
    kHalfWarp + 4;  // words: lanes read quads of neighbouring entries without conflict
// Half-warps of a warp write to different banks.
constexpr int kGroupWords = kGroup * kEntryStride + 16;

// Colours are not copied; their place in an entry holds what the tile contributes to its splat.
struct NoColors {};
__device__ __forceinline__ void copy_color(float* shared, NoColors, std::int32_t) {
  *reinterpret_cast<uint2*>(shared) = {0u, 0u};
}

// The sum of an entry over a tile of at most 2^10 pixels, each below 2^32 units, in two words that shared
// memory adds atomically: the low kLowBits of each subtile's sum, and its high ones below the pixels' number.
struct TileSum {
  static constexpr int kLowBits = 22, kPixelShift = 20;

  __device__ __forceinline__ static void add(Entry& entry, std::uint64_t weight, std::uint32_t pixels) {
    auto* words = reinterpret_cast<std::uint32_t*>(entry.color);
    atomicAdd(words, static_cast<std::uint32_t>(weight) & ((1u << kLowBits) - 1));
    atomicAdd(words + 1, static_cast<std::uint32_t>(weight >> kLowBits) | pixels << kPixelShift);
  }

  __device__ __forceinline__ static void send(const Entry& entry, std::int32_t splat,
                                              const ContributionSums& sums) {
    const uint2 words = *reinterpret_cast<const uint2*>(entry.color);
    if (words.y == 0) return;  // an entry that is composited has at least a pixel
    const std::uint64_t high = words.y & ((1u << kPixelShift) - 1);
    atomicAdd(reinterpret_cast<unsigned long long*>(sums.weights + splat),
              static_cast<unsigned long long>((high << kLowBits) + words.x));
    atomicAdd(sums.pixels + splat, static_cast<std::int32_t>(words.y >> kPixelShift));
  }
};

struct ContributionShared {
  EntryBatch<kForwardBatch> batch;
  __align__(16) std::uint32_t groups[Tile::kSubtiles][kGroupWords];
};

struct ContributionArguments {
  const PackedSplat* splats;
  const std::int32_t* isect_splats;
  const std::int64_t* tile_offsets;
  TileGrid grid;
  TileOrder order;
  ContributionSums sums;
};

// Adds up what the pixels of a subtile said of an entry.
__device__ __forceinline__ void sum_pixels(const std::uint32_t* words, Entry& entry) {
  std::uint64_t weight = 0;
  std::uint32_t pixels = 0;
#pragma unroll
  for (int i = 0; i < kHalfWarp / 4; ++i) {
    const uint4 four = reinterpret_cast<const uint4*>(words)[i];
    for (const std::uint32_t units : {four.x, four.y, four.z, four.w}) {
      weight += units;
      pixels += units != 0;
    }
  }
  if (pixels > 0) TileSum::add(entry, weight, pixels);
}

__global__ void __launch_bounds__(Tile::kThreads, 4) contributions_kernel(const ContributionArguments args) {
  constexpr int kBatch = kForwardBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  auto& shared = *reinterpret_cast<ContributionShared*>(shared_bytes);
  auto& batch = shared.batch;
  const int thread = threadIdx.x, lane = thread % kHalfWarp;
  wait_for_earlier_kernels();
  const TilePlace tile = locate_tile(args.grid, args.order.tile(static_cast<int>(blockIdx.x)));
  const Pixel pixel = locate_pixel(args.grid, tile, thread);
  const std::int64_t start = args.tile_offsets[tile.tile];
  const int count = static_cast<int>(args.tile_offsets[tile.tile + 1] - start);
  batch.init(thread);

  Compositor state;
  state.limit = pixel.inside ? kLog2Cut : INFINITY;
  std::uint32_t* const group = shared.groups[pixel.subtile];
  const auto splat_at = [&](int at) {
    return thread < kBatch && at < count ? args.isect_splats[start + at] : -1;
  };
  // `summed` is the splat of the thread's entry in the batch before, whose sums are complete at the barrier.
  std::int32_t splat = splat_at(thread), next_splat = splat_at(thread + kBatch), summed = -1;
  int buffer = 0;
  const auto send_sums = [&] {
    if (summed >= 0) TileSum::send(batch.entries[buffer ^ 1][thread], summed, args.sums);
    summed = -1;
  };
  batch.fetch(0, args.splats, NoColors{}, splat, thread);
  for (int base = 0; base < count; base += kBatch, buffer ^= 1) {
    if (thread < kBatch) batch.place(buffer, splat >= 0, tile, thread);
    const bool all_done = __syncthreads_and(state.done());
    send_sums();
    if (all_done) break;
    summed = splat;
    splat = next_splat;
    batch.fetch(buffer ^ 1, args.splats, NoColors{}, splat, thread);
    next_splat = splat_at(base + 2 * kBatch + thread);
    const unsigned done = __ballot_sync(kFullWarp, state.done()) >> (thread & kHalfWarp) & 0xffffu;
    const int quads =
        batch.template list<false, false>(buffer, pixel.subtile, lane, done == 0xffffu ? 0 : kBatch);
    char* const entries = reinterpret_cast<char*>(batch.entries[buffer]);
    const uint2* list = batch.quads(pixel.subtile);
    for (int i = 0; i < quads && !__all_sync(kFullWarp, state.done()); i += kGroup / 4) {
      const int filled = min(kGroup / 4, quads - i);
      for (int quad = 0; quad < filled; ++quad) {
        const QuadWeights weights = state.add(entries, QuadOffsets(list[i + quad]), pixel);
#pragma unroll
        for (int k = 0; k < 4; ++k) {
          group[(4 * quad + k) * kEntryStride + lane] =
              __float2uint_rn(weights.at[k] * static_cast<float>(kContributionScale));
        }
      }
      __syncwarp();
      if (lane < 4 * filled) {
        const std::uint32_t offset = batch.lists[pixel.subtile][4 * i + lane];
        sum_pixels(group + lane * kEntryStride, *reinterpret_cast<Entry*>(entries + offset));
      }
      __syncwarp();
    }
  }
  __syncthreads();
  send_sums();
}

void launch_contributions(const ContributionArguments& args, CudaStream stream) {
  const auto kernel = contributions_kernel;
  constexpr int kBytes = sizeof(ContributionShared);
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, kBytes), "contributions");
  launch_early("contributions", kernel,
               {static_cast<unsigned>(args.order.n_tiles), Tile::kThreads, stream, kBytes}, args);
}

}  // namespace

template <>
void contributions<float>(const ContributionInput<float>& in, const ContributionSums& sums,
                          Workspace& workspace, CudaStream stream) {
  check_tile_size("contributions", in.grid);
  check(cudaMemsetAsync(sums.weights, 0, in.n_splats * sizeof(*sums.weights), stream), "contributions");
  check(cudaMemsetAsync(sums.pixels, 0, in.n_splats * sizeof(*sums.pixels), stream), "contributions");
  const std::int64_t owned = in.grid.tile_end - in.grid.tile_begin;
  if (owned == 0 || in.n_splats == 0) return;
  const RasterizeInput<float> input{in.means2d, in.conics,       in.opacities,    nullptr,
                                    nullptr,    in.isect_splats, in.tile_offsets, in.n_splats,
                                    0,          in.grid,         in.known_splats};
  auto* packed = static_cast<PackedSplat*>(workspace.allocate_bytes(in.n_splats * sizeof(PackedSplat)));
  const TileOrder order(in.grid, owned, workspace.allocate<std::int32_t>(TileOrder::words(in.grid, owned)));
  prepare("contributions", input, packed, nullptr, order, stream);
  const ContributionArguments args{packed, in.isect_splats, in.tile_offsets, in.grid, order, sums};
  launch_contributions(args, stream);
}

}  // namespace blitzgs::cuda
