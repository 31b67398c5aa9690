// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include "common/rows.h"
#include "rasterize/forward.cuh"

namespace blitzgs::cuda {
namespace {

// A half-warp writes the weights of this many entries at its pixels; then each lane sums those of one entry.
constexpr int kGroup = 16;
constexpr int kEntryStride =
    kHalfWarp + 4;  // words: lanes read quads of neighbouring entries without conflict
// The 16 words of padding make the two half-warps of a warp write to different banks.
constexpr int kGroupWords = kGroup * kEntryStride + 16;

// A sum of numbers below 2^32, one for each of at most 2^10 pixels of a tile, and the number of these pixels.
// They are two words, to which subtiles add atomically in shared memory. `low` is the sum of the low kLowBits
// bits of the subtiles' sums. `high` has the sum of the other bits in its low kPixelShift bits, and the
// number of pixels in its high bits.
struct __align__(8) TileSum {
  static constexpr int kLowBits = 22, kPixelShift = 20;
  uint32_t low, high;

  __device__ __forceinline__ void add(uint64_t sum, uint32_t pixels) {
    atomicAdd(&low, uint32_t(sum) & ((1u << kLowBits) - 1));
    atomicAdd(&high, uint32_t(sum >> kLowBits) | pixels << kPixelShift);
  }
  __device__ __forceinline__ int64_t sum() const {
    const int64_t rest = high & ((1u << kPixelShift) - 1);
    return (rest << kLowBits) + low;
  }
  __device__ __forceinline__ uint32_t pixels() const { return high >> kPixelShift; }
};

// Finds the sums of an entry over a tile, which take the place of its colour: the TileSum of its weights and,
// with kSquares, that of their squares, which counts no pixels.
__device__ __forceinline__ TileSum* sums_of(Entry& entry) { return reinterpret_cast<TileSum*>(entry.color); }

// Replaces copy_color(): an entry gets no colour. Its sums begin at zero.
template <bool kSquares> struct NoColors {};
template <bool kSquares>
__device__ __forceinline__ void copy_color(float* shared, NoColors<kSquares>, int32_t) {
  using Sums = std::conditional_t<kSquares, uint4, uint2>;
  *reinterpret_cast<Sums*>(shared) = Sums{};
}

template <bool kSquares>
__device__ __forceinline__ void send_sums(Entry& entry, int32_t splat, const ContributionSums& sums) {
  const TileSum weights = sums_of(entry)[0];
  if (weights.pixels() == 0) return;  // no pixel composited the entry
  atomic_add(sums.weights + splat, weights.sum());
  atomicAdd(sums.pixels + splat, int32_t(weights.pixels()));
  if constexpr (kSquares) atomic_add(sums.squares + splat, sums_of(entry)[1].sum());
}

struct ContributionShared {
  EntryBatch<kForwardBatch> batch;
  __align__(16) uint32_t groups[Tile::kSubtiles][kGroupWords];
};

struct ContributionArguments {
  const PackedSplat* splats;
  const int32_t* isect_splats;
  const int64_t* tile_offsets;
  TileGrid grid;
  TileOrder order;
  ContributionSums sums;
};

// Returns 1, or 0 for 0. The compiler turns min(units, 1) into a comparison, an addition and a move.
__device__ __forceinline__ uint32_t one_if_any(uint32_t units) {
  uint32_t one;
  asm("min.u32 %0, %1, 1;" : "=r"(one) : "r"(units));
  return one;
}

// Sums an entry's weights, and with kSquares their squares, over the 16 pixels of a subtile, and adds the
// sums to those of the entry.
template <bool kSquares> __device__ __forceinline__ void sum_pixels(const uint32_t* words, Entry& entry) {
  uint64_t weight = 0, squares = 0;
  uint32_t pixels = 0;
#pragma unroll
  for (int i = 0; i < kHalfWarp / 4; ++i) {
    const uint4 four = reinterpret_cast<const uint4*>(words)[i];
    for (const uint32_t units : {four.x, four.y, four.z, four.w}) {
      weight += units;
      if constexpr (kSquares) squares += __umulhi(units, units);
      pixels += one_if_any(units);
    }
  }
  if (pixels == 0) return;
  sums_of(entry)[0].add(weight, pixels);
  if constexpr (kSquares) sums_of(entry)[1].add(squares, 0);
}

// The contributions of the splats (importance.h). One block of 256 threads per tile, one thread per pixel, as
// in forward_kernel (rasterize_fwd_cuda.cu). Reads the tile's list and the packed splats; adds to
// sums.weights, sums.pixels and, with kSquares, sums.squares [P] atomically, once per entry and tile.
template <bool kSquares>
__global__ void __launch_bounds__(Tile::kThreads, 4) contributions_kernel(const ContributionArguments args) {
  constexpr int kBatch = kForwardBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  auto& shared = *reinterpret_cast<ContributionShared*>(shared_bytes);
  auto& batch = shared.batch;
  const int thread = threadIdx.x, lane = thread % kHalfWarp;
  wait_for_earlier_kernels();
  const TilePlace tile = locate_tile(args.grid, args.order.tile(int(blockIdx.x)));
  const Pixel pixel = locate_pixel(args.grid, tile, thread);
  const int64_t start = args.tile_offsets[tile.tile];
  const int count = int(args.tile_offsets[tile.tile + 1] - start);
  batch.init(thread);

  Compositor<kContributionScale> state;
  state.limit = pixel.inside ? kLog2Cut : INFINITY;
  uint32_t* const group = shared.groups[pixel.subtile];
  const auto splat_at = [&](int at) {
    return thread < kBatch && at < count ? args.isect_splats[start + at] : -1;
  };
  // `summed` is the splat of this thread's entry in the previous batch. The barrier completes its sums.
  int32_t splat = splat_at(thread), next_splat = splat_at(thread + kBatch), summed = -1;
  int buffer = 0;
  const auto send_summed = [&] {
    if (summed >= 0) send_sums<kSquares>(batch.entries[buffer ^ 1][thread], summed, args.sums);
    summed = -1;
  };
  batch.fetch(0, args.splats, NoColors<kSquares>{}, splat, thread);
  for (int base = 0; base < count; base += kBatch, buffer ^= 1) {
    if (thread < kBatch) batch.place(buffer, splat >= 0, tile, thread);
    const bool all_done = __syncthreads_and(state.done());
    send_summed();
    if (all_done) break;
    summed = splat;
    splat = next_splat;
    batch.fetch(buffer ^ 1, args.splats, NoColors<kSquares>{}, splat, thread);
    next_splat = splat_at(base + 2 * kBatch + thread);
    const unsigned done = __ballot_sync(kFullWarp, state.done()) >> (thread & kHalfWarp) & 0xffffu;
    const int quads =
        batch.template list<false, false>(buffer, pixel.subtile, lane, done == 0xffffu ? 0 : kBatch);
    char* const entries = reinterpret_cast<char*>(batch.entries[buffer]);
    const uint2* list = batch.quads(pixel.subtile);
    for (int i = 0; i < quads && !__all_sync(kFullWarp, state.done()); i += kGroup / 4) {
      const int filled = min(kGroup / 4, quads - i);
      for (int quad = 0; quad < filled; ++quad) {
        const QuadAlphas alpha = state.alphas(entries, QuadOffsets(list[i + quad]), pixel);
#pragma unroll
        for (int k = 0; k < 4; ++k) {
          group[(4 * quad + k) * kEntryStride + lane] = __float2uint_rn(state.composite(alpha.at[k]));
        }
      }
      __syncwarp();
      if (lane < 4 * filled) {
        const uint32_t offset = batch.lists[pixel.subtile][4 * i + lane];
        sum_pixels<kSquares>(group + lane * kEntryStride, *reinterpret_cast<Entry*>(entries + offset));
      }
      __syncwarp();
    }
  }
  __syncthreads();
  send_summed();
}

}  // namespace

template <>
void contributions<float>(const RasterizeInput<float>& in, const ContributionSums& sums, Workspace& workspace,
                          CudaStream stream) {
  check_tile_size("contributions", in.grid);
  check(cudaMemsetAsync(sums.weights, 0, in.n_splats * sizeof(*sums.weights), stream), "contributions");
  check(cudaMemsetAsync(sums.pixels, 0, in.n_splats * sizeof(*sums.pixels), stream), "contributions");
  if (sums.squares) {
    check(cudaMemsetAsync(sums.squares, 0, in.n_splats * sizeof(*sums.squares), stream), "contributions");
  }
  const int64_t owned = in.grid.tile_end - in.grid.tile_begin;
  if (owned == 0 || in.n_splats == 0) return;
  auto* packed = static_cast<PackedSplat*>(workspace.allocate_bytes(in.n_splats * sizeof(PackedSplat)));
  const TileOrder order(in.grid, owned, workspace.allocate<int32_t>(TileOrder::words(in.grid, owned)));
  prepare("contributions", in, packed, nullptr, order, stream);
  const ContributionArguments args{packed, in.isect_splats, in.tile_offsets, in.grid, order, sums};
  launch_early("contributions", sums.squares ? contributions_kernel<true> : contributions_kernel<false>,
               {unsigned(order.n_tiles), Tile::kThreads, stream, sizeof(ContributionShared)}, args);
}

template void for_each_row(const ViewSums&, CudaStream);

}  // namespace blitzgs::cuda
