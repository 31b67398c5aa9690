// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <string>

#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

namespace {

struct ForwardArguments {
  const PackedRow* rows;
  ChannelChunk chunk;
  const float* backgrounds;
  const std::int32_t* isect_rows;
  const std::int64_t* tile_offsets;
  TileGrid grid;
  RasterizeOutput<float> out;
};

__global__ void pack_rows_kernel(RasterizeInput<float> in, PackedRow* rows, float4* colors) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i >= in.n_rows) return;
  const float conic[3] = {in.conics[3 * i], in.conics[3 * i + 1], in.conics[3 * i + 2]};
  const ConicFactor<float> factor = factor_conic(conic);
  PackedRow row;
  row.x = in.means2d[2 * i];
  row.y = in.means2d[2 * i + 1];
  row.l11 = kFactorScale * factor.l11;
  row.l21 = kFactorScale * factor.l21;
  row.l22 = kFactorScale * factor.l22;
  row.log2_opacity = log2f(in.opacities[i]);
  row.dx_per_dy = -conic[1] / conic[0];
  row.dy_per_dx = -conic[1] / conic[2];
  rows[i] = row;
  if (!colors) return;
  const float* color = in.colors + i * in.n_channels;
  float4 c{color[0], 0.f, 0.f, 0.f};
  if (in.n_channels > 1) c.y = color[1];
  if (in.n_channels > 2) c.z = color[2];
  if (in.n_channels > 3) c.w = color[3];
  colors[i] = c;
}

// One pixel's state while its list is composited. Entries are named by their offset in the batch.
template <int CHANNELS>
struct Compositor {
  static constexpr std::uint32_t kNone = ~0u;
  float transmittance = 1.f;
  float color[CHANNELS] = {};
  float limit;                  // least log2(alpha) that still counts: infinite once the pixel has ended
  std::uint32_t last = kNone;   // composited last
  std::uint32_t ended = kNone;  // at which the pixel ended

  __device__ __forceinline__ void add(const Entry& entry, std::uint32_t offset, const Pixel& pixel) {
    const float log2_a = log2_alpha(entry, pixel);
    const float alpha = fminf(exp2_approx(log2_a), static_cast<float>(kAlphaMax));
    const float next = __fmaf_rn(-alpha, transmittance, transmittance);
    const bool touched = log2_a >= limit;
    const bool ends = touched && next < static_cast<float>(kMinTransmittance);
    if (ends) {
      limit = INFINITY;
      ended = offset;
    }
    if (touched && !ends) {
      const float weight = alpha * transmittance;
      const float4 row_color = entry.color;
      transmittance = next;
      last = offset;
#pragma unroll
      for (int k = 0; k < CHANNELS; ++k) color[k] = __fmaf_rn(weight, channel(row_color, k), color[k]);
    }
  }

  __device__ __forceinline__ bool done() const { return limit == INFINITY; }
};

__device__ __forceinline__ int entry_number(std::uint32_t offset) {
  return static_cast<int>(offset / sizeof(Entry));
}

template <int TILE, int CHANNELS>
__global__ void __launch_bounds__(TILE* TILE) forward_kernel(const ForwardArguments args) {
  constexpr int kBatch = TILE * TILE < 256 ? TILE * TILE : 256;
  __shared__ EntryBatch<TILE, kBatch> batch;
  __shared__ int tile_work;
  const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
  const TilePlace tile = locate_tile<TILE>(args.grid);
  const Pixel pixel = locate_pixel<TILE>(args.grid, tile, warp, lane);
  const std::int64_t start = args.tile_offsets[tile.tile];
  const int count = static_cast<int>(args.tile_offsets[tile.tile + 1] - start);
  if (thread == 0) tile_work = 0;
  batch.init(thread);

  Compositor<CHANNELS> state;
  state.limit = pixel.inside ? kLog2Cut : INFINITY;
  int last = 0, work = pixel.inside ? count : 0;
  for (int base = 0; base < count; base += kBatch) {
    if (__syncthreads_and(state.done())) break;
    const bool present = thread < kBatch && base + thread < count;
    batch.load(args.rows, args.chunk, present ? args.isect_rows[start + base + thread] : -1, tile, thread);
    __syncthreads();
    const int n = batch.template list<false>(warp, lane, kBatch);
    for (int i = 0; i < n; i += 4) {
      if (i % 32 == 0 && __all_sync(kFullWarp, state.done())) break;
      std::uint32_t offsets[4];
      batch.quad(warp, i, offsets);
#pragma unroll
      for (int k = 0; k < 4; ++k) state.add(batch.at(offsets[k]), offsets[k], pixel);
    }
    if (state.last != state.kNone) last = base + entry_number(state.last) + 1;
    if (state.ended != state.kNone) work = base + entry_number(state.ended) + 1;
    state.last = state.ended = state.kNone;
  }

  if (pixel.inside) {
    float* render = args.out.renders + pixel.index * args.chunk.n_channels + args.chunk.first;
    const float* background =
        args.backgrounds ? args.backgrounds + static_cast<std::int64_t>(tile.camera) * args.chunk.n_channels +
                               args.chunk.first
                         : nullptr;
#pragma unroll
    for (int k = 0; k < CHANNELS; ++k) {
      if (k >= args.chunk.count) break;
      render[k] = background ? __fmaf_rn(state.transmittance, background[k], state.color[k]) : state.color[k];
    }
  }
  if (args.chunk.first > 0) return;
  if (pixel.inside) {
    args.out.transmittances[pixel.index] = state.transmittance;
    args.out.last_ids[pixel.index] = last;
  }
  work = __reduce_max_sync(kFullWarp, work);
  __syncthreads();
  if (lane == 0) atomicMax(&tile_work, work);
  __syncthreads();
  if (thread == 0) args.out.tile_work[tile.tile] = tile_work;
}

template <int TILE>
void launch_forward(const ForwardArguments& args, CudaStream stream) {
  const auto tiles = static_cast<unsigned>(args.grid.tile_end - args.grid.tile_begin);
  if (args.chunk.count == 4) {
    forward_kernel<TILE, 4><<<tiles, TILE * TILE, 0, stream>>>(args);
  } else {
    forward_kernel<TILE, 3><<<tiles, TILE * TILE, 0, stream>>>(args);
  }
  check_launch("rasterize_fwd");
}

void clear_unowned(const RasterizeInput<float>& in, const RasterizeOutput<float>& out, CudaStream stream) {
  const TileGrid& grid = in.grid;
  if (grid.tile_begin == 0 && grid.tile_end == grid.count()) return;
  const std::size_t pixels = static_cast<std::size_t>(grid.n_cameras) * grid.height * grid.width;
  check(cudaMemsetAsync(out.renders, 0, pixels * in.n_channels * sizeof(float), stream), "rasterize_fwd");
  check(cudaMemsetAsync(out.transmittances, 0, pixels * sizeof(float), stream), "rasterize_fwd");
  check(cudaMemsetAsync(out.last_ids, 0, pixels * sizeof(std::int32_t), stream), "rasterize_fwd");
  check(cudaMemsetAsync(out.tile_work, 0, grid.count() * sizeof(std::int32_t), stream), "rasterize_fwd");
}

}  // namespace

std::int64_t rasterize_aux_bytes(const TileGrid&, std::int64_t n_rows, std::int64_t, int n_channels) {
  return n_rows * static_cast<std::int64_t>(sizeof(PackedRow) + (n_channels <= 4 ? sizeof(float4) : 0));
}

template <>
void rasterize_fwd<float>(const RasterizeInput<float>& in, const RasterizeOutput<float>& out, std::int64_t,
                          void* aux, Workspace&, CudaStream stream) {
  clear_unowned(in, out, stream);
  if (in.grid.tile_end <= in.grid.tile_begin) return;
  float4* colors = in.n_channels <= 4 ? const_cast<float4*>(aux_colors(aux, in.n_rows)) : nullptr;
  if (in.n_rows > 0) {
    pack_rows_kernel<<<blocks_for(in.n_rows, 256), 256, 0, stream>>>(in, static_cast<PackedRow*>(aux),
                                                                     colors);
    check_launch("pack_rows");
  }
  for (int first = 0; first < in.n_channels; first += 4) {
    const ForwardArguments args{aux_rows(aux),
                                {colors, in.colors, in.n_channels, first, std::min(4, in.n_channels - first)},
                                in.backgrounds,
                                in.isect_rows,
                                in.tile_offsets,
                                in.grid,
                                out};
    if (in.grid.tile_size == 8) {
      launch_forward<8>(args, stream);
    } else if (in.grid.tile_size == 16) {
      launch_forward<16>(args, stream);
    } else if (in.grid.tile_size == 32) {
      launch_forward<32>(args, stream);
    } else {
      throw std::runtime_error("blitzgs::rasterize_fwd: tile_size must be 8, 16 or 32 on CUDA, got " +
                               std::to_string(in.grid.tile_size));
    }
  }
}

}  // namespace blitzgs::cuda
