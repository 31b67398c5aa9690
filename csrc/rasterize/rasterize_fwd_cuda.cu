// SPDX-License-Identifier: Apache-2.0
#include "rasterize/forward.cuh"

namespace blitzgs::cuda {
namespace {

struct ForwardArguments : ChunkInput {
  RasterizeOutput<float> out;
  // The number of splats of out.splat_gradients that all blocks, and each block, set to zero.
  int64_t zero_splats, splats_per_block;
  const int64_t* known_splats;  // null, or the actual number of splats
};

// Composites four entries of a batch into the colour of a pixel, and sets *last to the byte offset of the
// last of them that touches the pixel. One loop computes the weights, *last and the colour: if they were in
// separate loops, the compiler would emit divergent branches around the colours.
template <int CHANNELS>
__device__ __forceinline__ void add_colors(const char* entries, const QuadOffsets& offsets,
                                           const Pixel& pixel, Compositor<>& state, float* color,
                                           uint32_t* last) {
  const QuadAlphas alpha = state.alphas(entries, offsets, pixel);
#pragma unroll
  for (int k = 0; k < 4; ++k) {
    const float weight = state.composite(alpha.at[k]);
    const float4 splat_color = *reinterpret_cast<const float4*>(entry_at(entries, offsets.at[k]).color);
    if (alpha.touched[k]) {
      *last = offsets.at[k];
#pragma unroll
      for (int c = 0; c < CHANNELS; ++c) color[c] = __fmaf_rn(weight, channel(splat_color, c), color[c]);
    }
  }
}

__device__ __forceinline__ int entry_number(uint32_t offset) { return int(offset / sizeof(Entry)); }

template <int CHANNELS>
__device__ __forceinline__ void write_pixel(const ForwardArguments& args, const Pixel& pixel, int camera,
                                            const float* color, float transmittance, int last) {
  const ChannelChunk& chunk = args.chunk;
  float* render = args.out.renders + pixel.index * chunk.n_channels + chunk.first;
  const int64_t background = int64_t(camera) * chunk.n_channels + chunk.first;
#pragma unroll
  for (int k = 0; k < CHANNELS; ++k) {
    if (k >= chunk.count) break;
    render[k] =
        args.backgrounds ? __fmaf_rn(transmittance, args.backgrounds[background + k], color[k]) : color[k];
  }
  if (chunk.first > 0) return;
  args.out.transmittances[pixel.index] = transmittance;
  args.out.last_ids[pixel.index] = last;
}

// The most 16-byte zeros that a thread of forward_kernel writes. With too few tiles for this, a memset does.
constexpr int kMaxZeros = 16;
constexpr int kQuads = kSplatGradient / 4;  // 16-byte zeros per splat

// Sets this block's part of the splats' gradients to zero for the backward pass. Compositing is bound by
// instructions and not by memory, so these stores cost almost nothing. __stcs marks them as the first to
// leave the L2 cache, which the splats need.
__device__ __forceinline__ void zero_share(const ForwardArguments& args, int64_t n_splats, int threads) {
  auto* quads = reinterpret_cast<float4*>(args.out.splat_gradients);
  const int64_t begin = blockIdx.x * args.splats_per_block * kQuads;
  const int64_t end = min(begin + args.splats_per_block * kQuads, n_splats * kQuads);
  for (int64_t i = begin + threadIdx.x; i < end; i += threads) __stcs(quads + i, float4{});
}

// Composites the image (docs/image.md, sections 3 and 5). One block of 256 threads per tile, one thread per
// pixel. Reads the tile's list and the packed splats; writes renders [B, H, W, D] (the channels of the
// chunk), transmittances, last_ids and tile_work. The first blocks are the owned tiles. With clear_rest there
// is a block for each other tile, too, which writes zeros.
template <int CHANNELS>
__global__ void __launch_bounds__(Tile::kThreads, 4) forward_kernel(const ForwardArguments args) {
  constexpr int kBatch = kForwardBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  auto& batch = *reinterpret_cast<EntryBatch<kBatch>*>(shared_bytes);
  __shared__ int tile_work;
  const int thread = threadIdx.x, lane = thread % kHalfWarp;
  wait_for_earlier_kernels();
  const int64_t zero_splats = valid_splat_count(args.zero_splats, args.known_splats);
  const int block = int(blockIdx.x), owned = args.order.n_tiles;
  const int64_t index = block < owned                          ? args.order.tile(block)
                        : block - owned < args.grid.tile_begin ? block - owned
                                                               : block;
  const TilePlace tile = locate_tile(args.grid, index);
  const Pixel pixel = locate_pixel(args.grid, tile, thread);
  if (block >= owned) {
    zero_share(args, zero_splats, Tile::kThreads);
    constexpr float kBlack[CHANNELS] = {};
    if (pixel.inside) write_pixel<CHANNELS>(args, pixel, tile.camera, kBlack, 0.f, 0);
    if (thread == 0 && args.chunk.first == 0) args.out.tile_work[tile.tile] = 0;
    return;
  }
  const int64_t start = args.tile_offsets[tile.tile];
  const int count = int(args.tile_offsets[tile.tile + 1] - start);
  if (thread == 0) tile_work = 0;
  batch.init(thread);

  Compositor<> state;
  float color[CHANNELS] = {};
  uint32_t touched = state.kNone;  // byte offset of the last entry of the batch that touches the pixel
  state.limit = pixel.inside ? kLog2Cut : INFINITY;
  int last = 0, work = pixel.inside ? count : 0;
  const auto splat_at = [&](int at) {
    return thread < kBatch && at < count ? args.isect_splats[start + at] : -1;
  };
  int32_t splat = splat_at(thread), next_splat = splat_at(thread + kBatch);
  zero_share(args, zero_splats, Tile::kThreads);  // while the loads of the list are in flight
  batch.fetch(0, args.splats, args.chunk, splat, thread);
  for (int base = 0, buffer = 0; base < count; base += kBatch, buffer ^= 1) {
    if (thread < kBatch) batch.place(buffer, splat >= 0, tile, thread);
    if (__syncthreads_and(state.done())) break;
    splat = next_splat;
    batch.fetch(buffer ^ 1, args.splats, args.chunk, splat, thread);
    next_splat = splat_at(base + 2 * kBatch + thread);
    const unsigned done = __ballot_sync(kFullWarp, state.done()) >> (thread & kHalfWarp) & 0xffffu;
    const int quads =
        batch.template list<false, false>(buffer, pixel.subtile, lane, done == 0xffffu ? 0 : kBatch);
    const char* entries = reinterpret_cast<const char*>(batch.entries[buffer]);
    const uint2* list = batch.quads(pixel.subtile);
    for (int i = 0; i < quads && !__all_sync(kFullWarp, state.done());) {
      for (const int stop = min(i + 8, quads); i < stop; ++i) {
        add_colors<CHANNELS>(entries, QuadOffsets(list[i]), pixel, state, color, &touched);
      }
    }
    if (touched != state.kNone) last = base + entry_number(touched) + 1;
    if (state.ended != state.kNone) work = base + entry_number(state.ended) + 1;
    touched = state.ended = state.kNone;
  }

  if (pixel.inside) write_pixel<CHANNELS>(args, pixel, tile.camera, color, state.transmittance, last);
  if (args.chunk.first > 0) return;
  work = __reduce_max_sync(kFullWarp, work);
  __syncthreads();
  if (thread % 32 == 0) atomicMax(&tile_work, work);
  __syncthreads();
  if (thread == 0) args.out.tile_work[tile.tile] = tile_work;
}

void zero_gradients(const RasterizeOutput<float>& out, int64_t n_splats, CudaStream stream) {
  if (n_splats == 0) return;
  check(cudaMemsetAsync(out.splat_gradients, 0, n_splats * kSplatGradient * sizeof(float), stream),
        "rasterize_fwd");
}

void launch_forward(ForwardArguments args, CudaStream stream) {
  const auto tiles = unsigned(args.out.clear_rest ? args.grid.count() : args.order.n_tiles);
  if (kQuads * args.zero_splats > tiles * int64_t{kMaxZeros * Tile::kThreads}) {
    zero_gradients(args.out, args.zero_splats, stream);
    args.zero_splats = 0;
  }
  if (tiles == 0) return;
  args.splats_per_block = (args.zero_splats + tiles - 1) / tiles;
  const auto kernel = args.chunk.count == 4 ? forward_kernel<4> : forward_kernel<3>;
  launch_early("rasterize_fwd", kernel, {tiles, Tile::kThreads, stream, sizeof(EntryBatch<kForwardBatch>)},
               args);
}

// Which splats each pixel composites (rasterize.h).

struct PixelArguments {
  const PackedSplat* splats;
  const int32_t* isect_splats;
  const int64_t* tile_offsets;
  TileGrid grid;
  PixelSplats<float> out;
};

// Replaces copy_color(): an entry has no colour.
struct Colorless {};
__device__ __forceinline__ void copy_color(float*, Colorless, int32_t) {}

// One block of 256 threads per tile, one thread per pixel, as in forward_kernel. Reads the tile's list and
// the packed splats; writes the rows of the tile's pixels. The strongest splats of a pixel are kept in its
// row, which no other thread reads.
__global__ void __launch_bounds__(Tile::kThreads) pixel_splats_kernel(const PixelArguments args) {
  constexpr int kBatch = kForwardBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  auto& batch = *reinterpret_cast<EntryBatch<kBatch>*>(shared_bytes);
  const int thread = threadIdx.x, lane = thread % kHalfWarp;
  wait_for_earlier_kernels();
  const TilePlace tile = locate_tile(args.grid, blockIdx.x);
  const Pixel pixel = locate_pixel(args.grid, tile, thread);
  const PixelSplats<float>& out = args.out;
  const int64_t row = pixel.inside ? row_of(out, pixel.index) : -1;
  int32_t* const ids = out.ids + row * out.strongest;
  float* const weights = out.weights + row * out.strongest;
  const int64_t start = args.tile_offsets[tile.tile];
  const int count = int(args.tile_offsets[tile.tile + 1] - start);
  batch.init(thread);

  Compositor<> state;
  state.limit = row >= 0 ? kLog2Cut : INFINITY;
  int composited = 0, median = -1;
  float least = out.strongest > 0 ? 0.f : INFINITY;  // what a weight must exceed to be kept
  const auto splat_at = [&](int at) {
    return thread < kBatch && at < count ? args.isect_splats[start + at] : -1;
  };
  int32_t splat = splat_at(thread), next_splat = splat_at(thread + kBatch);
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
        const int entry = base + int(offsets.at[k] / sizeof(Entry));
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

int64_t rasterize_splat_bytes(int n_channels) {
  return sizeof(PackedSplat) + (n_channels <= kChunkChannels ? sizeof(float4) : 0);
}

bool rasterize_orders_tiles(const TileGrid& grid) { return grid.tile_end - grid.tile_begin != grid.count(); }

template <>
void rasterize_fwd<float>(const RasterizeInput<float>& in, const RasterizeOutput<float>& out,
                          const RasterizeAux& aux, Workspace&, CudaStream stream) {
  check_tile_size("rasterize_fwd", in.grid);
  const int64_t zero_splats = out.splat_gradients ? in.n_splats : 0;
  if (in.grid.count() == 0) {
    zero_gradients(out, zero_splats, stream);
    return;
  }
  prepare("rasterize_fwd", in, packed_splats(aux), packed_colors(aux, in.n_channels),
          TileOrder(in.grid, aux.composited, aux.order), stream);
  for (int first = 0; first < in.n_channels; first += kChunkChannels) {
    launch_forward({{in, aux, first}, out, zero_splats, 0, in.known_splats}, stream);
  }
}

template <>
void pixel_splats<float>(const RasterizeInput<float>& in, const PixelSplats<float>& out, Workspace& workspace,
                         CudaStream stream) {
  check_tile_size("pixel_splats", in.grid);
  if (in.grid.count() == 0) return;
  auto* packed = static_cast<PackedSplat*>(workspace.allocate_bytes(in.n_splats * sizeof(PackedSplat)));
  prepare("pixel_splats", in, packed, nullptr, TileOrder(in.grid, in.grid.count(), nullptr), stream);
  launch_early("pixel_splats", pixel_splats_kernel,
               {unsigned(in.grid.count()), Tile::kThreads, stream, sizeof(EntryBatch<kForwardBatch>)},
               PixelArguments{packed, in.isect_splats, in.tile_offsets, in.grid, out});
}

}  // namespace blitzgs::cuda
