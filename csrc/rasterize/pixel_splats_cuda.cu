// SPDX-License-Identifier: Apache-2.0
#include "rasterize/pixel_splats.h"

#include "common/cuda.cuh"
#include "rasterize/forward.cuh"

namespace blitzgs::cuda {

namespace {

struct PixelArguments {
  const PackedSplat* splats;
  const std::int32_t* isect_splats;
  const std::int64_t* tile_offsets;
  TileGrid grid;
  PixelSplats<float> out;
};

// Replaces copy_color(): an entry has no colour.
struct Colorless {};
__device__ __forceinline__ void copy_color(float*, Colorless, std::int32_t) {}

// Which splats each pixel composites (pixel_splats.h). One block of 256 threads per tile, one thread per
// pixel, as in forward_kernel (rasterize_fwd_cuda.cu). Reads the tile's list and the packed splats; writes
// the rows of the tile's pixels. The strongest splats of a pixel are kept in its row, which no other thread
// reads.
__global__ void __launch_bounds__(Tile::kThreads) pixel_splats_kernel(const PixelArguments args) {
  constexpr int kBatch = kForwardBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  auto& batch = *reinterpret_cast<EntryBatch<kBatch>*>(shared_bytes);
  const int thread = threadIdx.x, lane = thread % kHalfWarp;
  wait_for_earlier_kernels();
  const TilePlace tile = locate_tile(args.grid, blockIdx.x);
  const Pixel pixel = locate_pixel(args.grid, tile, thread);
  const PixelSplats<float>& out = args.out;
  const std::int64_t row = pixel.inside ? row_of(out, pixel.index) : -1;
  std::int32_t* const ids = out.ids + row * out.strongest;
  float* const weights = out.weights + row * out.strongest;
  const std::int64_t start = args.tile_offsets[tile.tile];
  const int count = static_cast<int>(args.tile_offsets[tile.tile + 1] - start);
  batch.init(thread);

  Compositor<> state;
  state.limit = row >= 0 ? kLog2Cut : INFINITY;
  int composited = 0, median = -1;
  float least = out.strongest > 0 ? 0.f : INFINITY;  // what a weight must exceed to be kept
  const auto splat_at = [&](int at) {
    return thread < kBatch && at < count ? args.isect_splats[start + at] : -1;
  };
  std::int32_t splat = splat_at(thread), next_splat = splat_at(thread + kBatch);
  batch.fetch(0, args.splats, Colorless{}, splat, thread);
  for (int base = 0, buffer = 0; base < count; base += kBatch, buffer ^= 1) {
    if (thread < kBatch) batch.place(buffer, splat >= 0, tile, thread);
    if (__syncthreads_and(state.done())) break;
    splat = next_splat;
    batch.fetch(buffer ^ 1, args.splats, Colorless{}, splat, thread);
    next_splat = splat_at(base + 2 * kBatch + thread);
    const unsigned done = __ballot_sync(kFullWarp, state.done()) >> (thread & kHalfWarp) & 0xffffu;
    const int quads =
        batch.template list<false, false>(buffer, pixel.subtile, lane, done == 0xffffu ? 0 : kBatch);
    const char* entries = reinterpret_cast<const char*>(batch.entries[buffer]);
    const uint2* list = batch.quads(pixel.subtile);
    for (int i = 0; i < quads && !__all_sync(kFullWarp, state.done()); ++i) {
      const QuadOffsets offsets(list[i]);
      const QuadAlphas alpha = state.alphas(entries, offsets, pixel);
#pragma unroll
      for (int k = 0; k < 4; ++k) {
        const float before = state.transmittance;
        const float weight = state.composite(alpha.at[k]);
        if (!alpha.touched[k]) continue;
        const int entry = base + static_cast<int>(offsets.at[k] / sizeof(Entry));
        if (before > kMedianTransmittance) median = entry;
        if (weight > least) {
          least = keep_strongest(ids, weights, out.strongest, composited, args.isect_splats[start + entry],
                                 weight);
        }
        ++composited;
      }
    }
    state.ended = state.kNone;
  }
  if (row < 0) return;
  out.transmittances[row] = state.transmittance;
  out.counts[row] = composited;
  out.medians[row] = median < 0 ? -1 : args.isect_splats[start + median];
  for (int k = composited; k < out.strongest; ++k) {
    ids[k] = -1;
    weights[k] = 0.f;
  }
}

}  // namespace

template <>
void pixel_splats<float>(const RasterizeInput<float>& in, const PixelSplats<float>& out, Workspace& workspace,
                         CudaStream stream) {
  check_tile_size("pixel_splats", in.grid);
  if (in.grid.count() == 0) return;
  auto* packed = static_cast<PackedSplat*>(workspace.allocate_bytes(in.n_splats * sizeof(PackedSplat)));
  prepare("pixel_splats", in, packed, nullptr, TileOrder(in.grid, in.grid.count(), nullptr), stream);
  launch_early(
      "pixel_splats", pixel_splats_kernel,
      {static_cast<unsigned>(in.grid.count()), Tile::kThreads, stream, sizeof(EntryBatch<kForwardBatch>)},
      PixelArguments{packed, in.isect_splats, in.tile_offsets, in.grid, out});
}

}  // namespace blitzgs::cuda
