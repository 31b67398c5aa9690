// SPDX-License-Identifier: Apache-2.0
// The gradient of compositing (docs/image.md, sections 3 and 5). A half-warp visits the list of its 4x4
// subtile from the last entry to the first, one lane per pixel. The state of a pixel is its transmittance and
// one number, `behind` of rasterize.h, so the backward pass needs only the final transmittance and last_ids
// from the forward pass. The half-warp writes w and g (rasterize.h) of sixteen entries to shared memory. Each
// lane then sums over the sixteen pixels for one of the entries (gradients.cuh).

#include "rasterize/gradients.cuh"

namespace blitzgs::cuda {
namespace {

struct BackwardArguments : ChunkInput {
  RasterizeSaved<float> saved;
  PackedGradient* splat_gradients;  // [P], added to atomically, or null
  PackedGradient* entry_gradients;  // [I], written once each (deterministic)
};

template <int CHANNELS, bool DETERMINISTIC> struct BackwardShared {
  static constexpr int kBatch = DETERMINISTIC ? 64 : 256;
  static constexpr int kWarps = Tile::kWarps, kSubtiles = Tile::kSubtiles;
  EntryBatch<kBatch> batch;
  SubtileGradient<CHANNELS> v_render[kSubtiles];
  float2 group[kSubtiles][kGroup * kGroupStride];  // weight, g
  PackedGradient partial[DETERMINISTIC ? kWarps : 1][DETERMINISTIC ? kBatch : 1];
  int32_t splat[2][kBatch + 1];  // -1 where there is no entry
  int last;
};

__device__ __forceinline__ float4 add_halves(float4 a) {
  return {a.x + __shfl_xor_sync(kFullWarp, a.x, kHalfWarp), a.y + __shfl_xor_sync(kFullWarp, a.y, kHalfWarp),
          a.z + __shfl_xor_sync(kFullWarp, a.z, kHalfWarp), a.w + __shfl_xor_sync(kFullWarp, a.w, kHalfWarp)};
}

// Sums a group of entries, list[0 .. filled) of the half-warp's list, over the subtile's pixels, one lane per
// entry. Adds them to the splats' gradients atomically or (DETERMINISTIC) stores them in shared.partial.
template <int CHANNELS, bool ABSOLUTE, bool DETERMINISTIC>
__device__ __forceinline__ void flush_group(BackwardShared<CHANNELS, DETERMINISTIC>& shared,
                                            const BackwardArguments& args, const TilePlace& tile,
                                            const Pixel& pixel, int buffer, int filled,
                                            const uint16_t* list) {
  __syncwarp();
  const int slot = threadIdx.x % kGroup;
  const uint32_t offset = slot < filled ? list[slot] : shared.batch.kNothing;
  const Entry& shape = entry_at(reinterpret_cast<const char*>(shared.batch.entries[buffer]), offset);
  const int my_entry = int(offset / sizeof(Entry));
  constexpr int kColumns = Tile::kColumns, kMiddle = kSubtile / 2;
  const float x = float(tile.left + pixel.subtile % kColumns * kSubtile + kMiddle) - shape.x;
  const float y = float(tile.top + pixel.subtile / kColumns * kSubtile + kMiddle) - shape.y;
  const EntrySums<CHANNELS> sums = sum_pixels<CHANNELS, ABSOLUTE>(
      shared.group[pixel.subtile] + slot * kGroupStride, shared.v_render[pixel.subtile], shape, x, y);
  PackedGradient gradient = finish<CHANNELS, ABSOLUTE>(sums, shape, x, y);
  bool touched = sums.g != 0.f || (ABSOLUTE && (sums.abs_x != 0.f || sums.abs_y != 0.f));
#pragma unroll
  for (int k = 0; k < CHANNELS; ++k) touched |= sums.color[k] != 0.f;
  touched &= slot < filled;
  if constexpr (DETERMINISTIC) {  // both halves of the warp visit the same list, so their sums are added here
    const bool half = threadIdx.x & kHalfWarp;
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      if (!touched) gradient.quads[i] = {0.f, 0.f, 0.f, 0.f};
      gradient.quads[i] = add_halves(gradient.quads[i]);
    }
    if (offset != shared.batch.kNothing) {
      float4* target = shared.partial[threadIdx.x / 32][my_entry].quads;
      target[half] = half ? gradient.quads[1] : gradient.quads[0];
      if (!half) target[2] = gradient.quads[2];
    }
  } else if (touched) {
    float* target = reinterpret_cast<float*>(args.splat_gradients + shared.splat[buffer][my_entry]);
    const float4 a = gradient.quads[0], b = gradient.quads[1], c = gradient.quads[2];
    add_quad(target, a.x, a.y, a.z, a.w);
    add_quad(target + 4, b.x, b.y, b.z, b.w);
    if constexpr (CHANNELS > 3 || ABSOLUTE) {
      add_quad(target + 8, c.x, c.y, c.z, c.w);
    } else {
      atomicAdd(target + 8, c.x);
    }
  }
  __syncwarp();
}

// Returns the state of a pixel behind its last entry, and writes the pixel's gradient to shared.v_render.
// That of a pixel without splats (last is 0) counts as zero, also if it is NaN, as of 1 / depth.
template <int CHANNELS, bool WIDE, class Shared>
__device__ __forceinline__ BackwardPixel<CHANNELS> start_pixel(Shared& shared, const BackwardArguments& args,
                                                               const Pixel& pixel, int last, int camera) {
  BackwardPixel<CHANNELS> state;
  state.transmittance = pixel.inside ? args.saved.transmittances[pixel.index] : 1.f;
  const ChannelChunk& chunk = args.chunk;
  const float* v_render = args.saved.v_renders + pixel.index * chunk.n_channels;
  float open = 0.f;  // the gradient of the loss by the final transmittance
  if (pixel.inside && args.saved.v_alphas && chunk.first == 0) open = -args.saved.v_alphas[pixel.index];
#pragma unroll
  for (int k = 0; k < CHANNELS; ++k) {
    const bool present = pixel.inside && k < chunk.count;
    const float v = present ? v_render[chunk.first + k] : 0.f;
    state.v[k] = last > 0 ? v : 0.f;
    shared.v_render[pixel.subtile].v[k][threadIdx.x % kHalfWarp] = state.v[k];
  }
  if (pixel.inside && args.backgrounds) {
    const float* background = args.backgrounds + int64_t(camera) * chunk.n_channels;
    const int first = WIDE ? 0 : chunk.first, end = WIDE ? chunk.n_channels : chunk.first + chunk.count;
    for (int k = first; k < end; ++k) open += v_render[k] * background[k];
  }
  state.behind = open;
  return state;
}

// v_render . color over all channels.
__device__ __noinline__ float wide_dot(const BackwardArguments& args, const Pixel& pixel, int32_t splat) {
  const int n = args.chunk.n_channels;
  const float* v = args.saved.v_renders + pixel.index * n;
  const float* color = args.chunk.colors + int64_t(splat) * n;
  float sum = 0.f;
  for (int k = 0; k < n; ++k) sum = __fmaf_rn(v[k], color[k], sum);
  return sum;
}

// One block of 256 threads per tile, one half-warp per subtile, one thread per pixel. Reads the tile's list
// from isect_splats, the packed splats and the pixels' gradients; adds to splat_gradients [P] atomically or
// (DETERMINISTIC) writes entry_gradients [I]. WIDE: g sums over all channels and not over those of the chunk
// alone, as absolute sums require.
template <int CHANNELS, bool ABSOLUTE, bool DETERMINISTIC, bool WIDE>
__global__ void __launch_bounds__(Tile::kThreads, 768 / Tile::kThreads)
    backward_kernel(const BackwardArguments args) {
  using Shared = BackwardShared<CHANNELS, DETERMINISTIC>;
  constexpr int kBatch = Shared::kBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  Shared& shared = *reinterpret_cast<Shared*>(shared_bytes);
  wait_for_earlier_kernels();
  const int thread = threadIdx.x, lane = thread % kHalfWarp;
  const int64_t index = args.order.tile(int(blockIdx.x));
  if (index < args.grid.tile_begin || index >= args.grid.tile_end) return;  // forward alone composited it
  const TilePlace tile = locate_tile(args.grid, index);
  const int64_t start = args.tile_offsets[tile.tile];
  if (args.tile_offsets[tile.tile + 1] == start) return;
  const Pixel pixel = locate_pixel(args.grid, tile, thread);

  if (thread == 0) shared.last = 0;
  if (thread < 2) shared.splat[thread][kBatch] = -1;
  shared.batch.init(thread);
  const int pixel_last = pixel.inside ? args.saved.last_ids[pixel.index] : 0;
  auto state = start_pixel<CHANNELS, WIDE>(shared, args, pixel, pixel_last, tile.camera);
  int list_last = pixel_last;  // the maximum over the pixels that share a list
  for (int step = DETERMINISTIC ? kHalfWarp : kHalfWarp / 2; step > 0; step /= 2) {
    list_last = max(list_last, __shfl_xor_sync(kFullWarp, list_last, step));
  }
  __syncthreads();
  if (lane == 0) atomicMax(&shared.last, list_last);
  __syncthreads();
  const int count = shared.last;
  const auto splat_at = [&](int at) {
    return thread < kBatch && at >= 0 && at < count ? args.isect_splats[start + at] : -1;
  };
  int base = (count - 1) / kBatch * kBatch, buffer = 0;
  int32_t splat = splat_at(base + thread), next_splat = splat_at(base - kBatch + thread);
  shared.batch.fetch(0, args.splats, args.chunk, splat, thread);
  for (; base >= 0 && count > 0; base -= kBatch, buffer ^= 1) {
    if (thread < kBatch) {
      shared.splat[buffer][thread] = splat;
      shared.batch.place(buffer, splat >= 0, tile, thread);
    }
    if constexpr (DETERMINISTIC) {
      float4* mine = shared.partial[thread / 32][0].quads;
      for (int i = thread % 32; i < 3 * kBatch; i += 32) mine[i] = {0.f, 0.f, 0.f, 0.f};
    }
    __syncthreads();
    splat = next_splat;
    shared.batch.fetch(buffer ^ 1, args.splats, args.chunk, splat, thread);
    next_splat = splat_at(base - 2 * kBatch + thread);

    const char* entries = reinterpret_cast<const char*>(shared.batch.entries[buffer]);
    const auto dot = [&](uint32_t offset) {
      if constexpr (WIDE) {
        const int wide_splat = pixel.inside ? shared.splat[buffer][offset / sizeof(Entry)] : -1;
        return wide_splat < 0 ? 0.f : wide_dot(args, pixel, wide_splat);
      } else {
        const float4 color = *reinterpret_cast<const float4*>(entry_at(entries, offset).color);
        float sum = state.v[0] * color.x;
#pragma unroll
        for (int k = 1; k < CHANNELS; ++k) sum = __fmaf_rn(state.v[k], channel(color, k), sum);
        return sum;
      }
    };
    const uint32_t last = uint32_t(min(max(pixel_last - base, 0), kBatch) * int(sizeof(Entry)));
    const int quads =
        shared.batch.template list<true, DETERMINISTIC>(buffer, pixel.subtile, lane, list_last - base);
    const uint2* list = shared.batch.quads(pixel.subtile);
    for (int i = 0; i < quads;) {
      const uint2* const group = list + i;
      float2* slots = shared.group[pixel.subtile] + lane;
      const int filled = min(kGroup / 4, quads - i);
      for (const int stop = i + filled; i < stop; ++i, slots += 4 * kGroupStride) {
        state.add(entries, QuadOffsets(list[i]), last, pixel, dot, slots);
      }
      flush_group<CHANNELS, ABSOLUTE, DETERMINISTIC>(shared, args, tile, pixel, buffer, 4 * filled,
                                                     reinterpret_cast<const uint16_t*>(group));
    }
    if constexpr (DETERMINISTIC) {
      __syncthreads();
      for (int i = thread; i < 3 * kBatch && base + i / 3 < count; i += Tile::kThreads) {
        float4 sum = shared.partial[0][0].quads[i];
        for (int other = 1; other < Shared::kWarps; ++other) {
          const float4 part = shared.partial[other][0].quads[i];
          sum = {sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w};
        }
        args.entry_gradients[start + base].quads[i] = sum;
      }
      __syncthreads();
    }
  }
}

template <int CHANNELS, bool ABSOLUTE, bool DETERMINISTIC, bool WIDE>
void launch_backward(const BackwardArguments& args, CudaStream stream) {
  const LaunchShape shape{unsigned(args.order.n_tiles), Tile::kThreads, stream,
                          sizeof(BackwardShared<CHANNELS, DETERMINISTIC>)};
  launch_early("rasterize_bwd", backward_kernel<CHANNELS, ABSOLUTE, DETERMINISTIC, WIDE>, shape, args);
}

void dispatch_backward(const BackwardArguments& args, bool absolute, CudaStream stream) {
  const bool wide = absolute && args.chunk.n_channels > 4 && args.chunk.first == 0;
  if (args.entry_gradients) {
    wide ? launch_backward<4, true, true, true>(args, stream)
         : launch_backward<4, true, true, false>(args, stream);
  } else if (wide) {
    launch_backward<4, true, false, true>(args, stream);
  } else if (absolute && args.chunk.first == 0) {
    launch_backward<4, true, false, false>(args, stream);
  } else if (args.chunk.count == 4) {
    launch_backward<4, false, false, false>(args, stream);
  } else {
    launch_backward<3, false, false, false>(args, stream);
  }
}

// Computes the gradients of all splats for one chunk of channels at a time. The constructor allocates what
// deterministic gradients need and sorts the list by splat.
class SplatGradientSums {
 public:
  SplatGradientSums(const RasterizeInput<float>& in, const RasterizeSaved<float>& saved, int64_t n_isects,
                    bool deterministic, Workspace& workspace, CudaStream stream)
      : saved_(saved),
        n_isects_(n_isects),
        stream_(stream),
        empty_(n_isects == 0 || in.grid.tile_end <= in.grid.tile_begin) {
    check_tile_size("rasterize_bwd", in.grid);
    if (empty_ || !deterministic) return;
    entries_ = static_cast<PackedGradient*>(workspace.allocate_bytes(n_isects * sizeof(PackedGradient)));
    sorted_ = sort_entries(in.isect_splats, n_isects, in.n_splats, workspace, stream);
  }

  // Adds the gradients by the channels of a chunk to `packed` [P].
  void add(const ChunkInput& chunk, bool absolute, PackedGradient* packed) const {
    if (empty_) return;
    if (entries_) {
      check(cudaMemsetAsync(entries_, 0, n_isects_ * sizeof(PackedGradient), stream_), "rasterize_bwd");
    }
    dispatch_backward({chunk, saved_, packed, entries_}, absolute, stream_);
    if (!entries_) return;
    sum_entries_kernel<<<blocks_for(3 * n_isects_, 256), 256, 0, stream_>>>(
        sorted_.splats, sorted_.entries, n_isects_, chunk.tile_offsets + chunk.grid.count(), entries_,
        packed);
    check_launch("rasterize_bwd");
  }

 private:
  const RasterizeSaved<float>& saved_;
  int64_t n_isects_;
  CudaStream stream_;
  bool empty_;
  EntriesBySplat sorted_{};
  PackedGradient* entries_ = nullptr;
};

}  // namespace

template <>
void rasterize_bwd<float>(const RasterizeInput<float>& in, const RasterizeSaved<float>& saved,
                          int64_t n_isects, const RasterizeAux& aux, bool deterministic,
                          const RasterizeGradients<float>& gradients, Workspace& workspace,
                          CudaStream stream) {
  if (in.n_splats == 0) return;
  const bool absolute = gradients.v_means2d_abs != nullptr;
  const SplatGradientSums splats(in, saved, n_isects, deterministic, workspace, stream);
  auto* packed = static_cast<PackedGradient*>(workspace.allocate_bytes(in.n_splats * sizeof(PackedGradient)));
  for (int first = 0; first < in.n_channels; first += kChunkChannels) {
    const ChunkInput input(in, aux, first);
    check(cudaMemsetAsync(packed, 0, in.n_splats * sizeof(PackedGradient), stream), "rasterize_bwd");
    splats.add(input, absolute, packed);
    launch_early("rasterize_bwd", unpack_kernel,
                 {blocks_for(in.n_splats, kUnpackThreads), kUnpackThreads, stream}, packed, in.n_splats,
                 input.chunk, absolute && first > 0, gradients);
  }
}

void rasterize_bwd_packed(const RasterizeInput<float>& in, const RasterizeSaved<float>& saved,
                          int64_t n_isects, const RasterizeAux& aux, bool deterministic, bool absolute,
                          float* packed, Workspace& workspace, CudaStream stream) {
  if (in.n_splats == 0) return;
  const SplatGradientSums splats(in, saved, n_isects, deterministic, workspace, stream);
  splats.add({in, aux, 0}, absolute, reinterpret_cast<PackedGradient*>(packed));
}

}  // namespace blitzgs::cuda
