// SPDX-License-Identifier: Apache-2.0
// The gradient of compositing. A warp walks its subtile's list from the back, a lane a pixel, so the pixel's
// state is a transmittance and one number (what lies behind, dotted with the pixel's gradient), and nothing
// but the final transmittance has to be kept from the forward pass. Per entry and pixel that leaves two
// numbers: the weight alpha T and g = dL/d(ln alpha). Sixteen entries at a time, the warp transposes them
// through shared memory, and each lane then sums for one entry over half of the pixels: the weights against
// the pixels' gradients, and the moments of g over the pixel grid, from which the gradients of mean and conic
// follow.
#include <algorithm>
#include <cub/device/device_radix_sort.cuh>
#include <string>

#include "rasterize/entry_sums.cuh"

namespace blitzgs::cuda {

namespace {

struct BackwardArguments {
  const PackedRow* rows;
  ChannelChunk chunk;
  const float* backgrounds;
  const std::int32_t* isect_rows;
  const std::int64_t* tile_offsets;
  TileGrid grid;
  RasterizeSaved<float> saved;
  PackedGradient* row_gradients;    // [P], added to atomically, or null
  PackedGradient* entry_gradients;  // [I], written once each (deterministic)
};

template <int TILE, bool DETERMINISTIC>
struct BackwardShared {
  static constexpr int kBatch = DETERMINISTIC       ? (TILE == 32 ? 32 : 64)
                                : TILE * TILE < 256 ? TILE * TILE
                                                    : 256;
  static constexpr int kWarps = Tile<TILE>::kWarps;
  EntryBatch<TILE, kBatch> batch;
  std::int32_t row[kBatch];
  float4 v_render[kWarps][32];
  float2 group[kWarps][kGroup * kGroupStride];  // weight, g
  PackedGradient partial[DETERMINISTIC ? kWarps : 1][DETERMINISTIC ? kBatch : 1];
  int last;
};

// Sums the group's entries, list[0 .. filled) of the warp's list, and hands the results on.
template <int TILE, int CHANNELS, bool ABSOLUTE, bool DETERMINISTIC>
__device__ __forceinline__ void flush_group(BackwardShared<TILE, DETERMINISTIC>& shared,
                                            const BackwardArguments& args, const Pixel& pixel, int warp,
                                            int lane, int filled, const std::uint16_t* list) {
  __syncwarp();
  const int slot = lane % kGroup, half = lane / kGroup;
  const std::uint32_t offset = slot < filled ? list[slot] : 0;
  const Entry& shape = shared.batch.at(offset);
  const int my_entry = static_cast<int>(offset / sizeof(Entry));
  const float centre_x = static_cast<float>(pixel.left + kSubtileWidth / 2);
  const float centre_y = static_cast<float>(pixel.top + kSubtileHeight / 2);
  EntrySums<CHANNELS> sums = sum_half<CHANNELS, ABSOLUTE>(
      shared.group[warp] + slot * kGroupStride, shared.v_render[warp], shape, centre_x, centre_y, half);
#pragma unroll
  for (int k = 0; k < CHANNELS; ++k) sums.color[k] = add_halves(sums.color[k]);
  sums.g = add_halves(sums.g);
  sums.gx = add_halves(sums.gx);
  sums.gy = add_halves(sums.gy);
  sums.gxx = add_halves(sums.gxx);
  sums.gxy = add_halves(sums.gxy);
  sums.gyy = add_halves(sums.gyy);
  if constexpr (ABSOLUTE) {
    sums.abs_x = add_halves(sums.abs_x);
    sums.abs_y = add_halves(sums.abs_y);
  }
  const PackedGradient gradient = finish<CHANNELS, ABSOLUTE>(sums, shape, centre_x, centre_y);
  bool touched = sums.g != 0.f;
#pragma unroll
  for (int k = 0; k < CHANNELS; ++k) touched |= sums.color[k] != 0.f;
  if (slot < filled && (touched || DETERMINISTIC || ABSOLUTE)) {
    if constexpr (DETERMINISTIC) {
      float4* target = shared.partial[warp][my_entry].quads;
      target[half] = half ? gradient.quads[1] : gradient.quads[0];
      if (half == 0) target[2] = gradient.quads[2];
    } else {
      float* target = reinterpret_cast<float*>(args.row_gradients + shared.row[my_entry]);
      const float4 quad = half ? gradient.quads[1] : gradient.quads[0];
      add_quad(target + 4 * half, quad.x, quad.y, quad.z, quad.w);
      if constexpr (CHANNELS > 3 || ABSOLUTE) {
        const float4 tail = gradient.quads[2];
        if (half == 0) add_quad(target + 8, tail.x, tail.y, tail.z, tail.w);
      } else {
        if (half == 0) atomicAdd(target + 8, gradient.quads[2].x);
      }
    }
  }
  __syncwarp();
}

// One pixel's state while its list is walked from the back.
template <int CHANNELS>
struct BackwardPixel {
  float transmittance;  // in front of the entries walked so far
  float behind;         // v . (what lies behind, background included)
  float v[CHANNELS];
  int last;

  // last: offset in the batch from which on the pixel has composited nothing.
  __device__ __forceinline__ float2 add(const Entry& entry, std::uint32_t offset, std::uint32_t last,
                                        const Pixel& pixel) {
    const float log2_a = log2_alpha(entry, pixel);
    const float raw = exp2_approx(log2_a);
    const bool touched = log2_a >= kLog2Cut && offset < last;
    const float alpha = touched ? fminf(raw, static_cast<float>(kAlphaMax)) : 0.f;
    const float inverse = reciprocal_approx(1.f - alpha);
    transmittance *= inverse;
    const float weight = alpha * transmittance;
    const float4 row_color = entry.color;
    float dot = v[0] * row_color.x;
#pragma unroll
    for (int k = 1; k < CHANNELS; ++k) dot = __fmaf_rn(v[k], channel(row_color, k), dot);
    const float v_alpha = __fmaf_rn(transmittance, dot, -behind * inverse);
    if (touched) behind = __fmaf_rn(weight, dot, behind);  // not 0 * NaN where the row's color is NaN
    const bool differentiable = touched && raw <= static_cast<float>(kAlphaMax);
    return {weight, differentiable ? v_alpha * alpha : 0.f};
  }
};

template <int TILE, int CHANNELS, bool DETERMINISTIC>
__device__ __forceinline__ BackwardPixel<CHANNELS> start_pixel(BackwardShared<TILE, DETERMINISTIC>& shared,
                                                               const BackwardArguments& args,
                                                               const Pixel& pixel, int camera, int warp,
                                                               int lane) {
  BackwardPixel<CHANNELS> state;
  state.last = pixel.inside ? args.saved.last_ids[pixel.index] : 0;
  state.transmittance = pixel.inside ? args.saved.transmittances[pixel.index] : 1.f;
  float open = 0.f;  // gradient of the final transmittance
  if (pixel.inside && args.saved.v_alphas && args.chunk.first == 0) open = -args.saved.v_alphas[pixel.index];
#pragma unroll
  for (int k = 0; k < CHANNELS; ++k) {
    const bool present = pixel.inside && k < args.chunk.count;
    state.v[k] =
        present ? args.saved.v_renders[pixel.index * args.chunk.n_channels + args.chunk.first + k] : 0.f;
    if (present && args.backgrounds) {
      open += state.v[k] * args.backgrounds[camera * args.chunk.n_channels + args.chunk.first + k];
    }
  }
  state.behind = open * state.transmittance;
  shared.v_render[warp][lane] = {state.v[0], state.v[1], state.v[2],
                                 CHANNELS > 3 ? state.v[CHANNELS - 1] : 0.f};
  return state;
}

template <int TILE, int CHANNELS, bool ABSOLUTE, bool DETERMINISTIC>
__global__ void __launch_bounds__(TILE* TILE, TILE <= 16 ? 1024 / (TILE * TILE) : 1)
    backward_kernel(const BackwardArguments args) {
  using Shared = BackwardShared<TILE, DETERMINISTIC>;
  constexpr int kBatch = Shared::kBatch;
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  Shared& shared = *reinterpret_cast<Shared*>(shared_bytes);
  const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
  const TilePlace tile = locate_tile<TILE>(args.grid);
  const std::int64_t start = args.tile_offsets[tile.tile];
  if (args.tile_offsets[tile.tile + 1] == start) return;
  const Pixel pixel = locate_pixel<TILE>(args.grid, tile, warp, lane);

  if (thread == 0) shared.last = 0;
  shared.batch.init(thread);
  BackwardPixel<CHANNELS> state =
      start_pixel<TILE, CHANNELS, DETERMINISTIC>(shared, args, pixel, tile.camera, warp, lane);
  const int warp_last = __reduce_max_sync(kFullWarp, state.last);
  __syncthreads();
  if (lane == 0) atomicMax(&shared.last, warp_last);
  __syncthreads();
  const int count = shared.last;

  for (int base = (count - 1) / kBatch * kBatch; base >= 0 && count > 0; base -= kBatch) {
    __syncthreads();
    const bool present = thread < kBatch && base + thread < count;
    const std::int32_t row = present ? args.isect_rows[start + base + thread] : -1;
    if (thread < kBatch) shared.row[thread] = row;
    shared.batch.load(args.rows, args.chunk, row, tile, thread);
    if constexpr (DETERMINISTIC) {
      float4* mine = shared.partial[warp][0].quads;
      for (int i = lane; i < 3 * kBatch; i += 32) mine[i] = {0.f, 0.f, 0.f, 0.f};
    }
    __syncthreads();

    const int warp_limit = warp_last - base, pixel_limit = min(max(state.last - base, 0), kBatch);
    const std::uint32_t last = static_cast<std::uint32_t>(pixel_limit * sizeof(Entry));
    const int n = shared.batch.template list<true>(warp, lane, warp_limit);
    for (int first = 0; first < n; first += kGroup) {
      const int filled = min(kGroup, n - first);
      float2* slot = shared.group[warp] + lane;
      for (int i = 0; i < filled; i += 4, slot += 4 * kGroupStride) {
        std::uint32_t offsets[4];
        shared.batch.quad(warp, first + i, offsets);
#pragma unroll
        for (int k = 0; k < 4; ++k) {
          slot[k * kGroupStride] = state.add(shared.batch.at(offsets[k]), offsets[k], last, pixel);
        }
      }
      flush_group<TILE, CHANNELS, ABSOLUTE, DETERMINISTIC>(shared, args, pixel, warp, lane, filled,
                                                           &shared.batch.lists[warp][first]);
    }
    if constexpr (DETERMINISTIC) {
      __syncthreads();
      for (int i = thread; i < 3 * kBatch && base + i / 3 < count; i += TILE * TILE) {
        float4 sum = shared.partial[0][0].quads[i];
        for (int other = 1; other < Shared::kWarps; ++other) {
          const float4 part = shared.partial[other][0].quads[i];
          sum = {sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w};
        }
        args.entry_gradients[start + base].quads[i] = sum;
      }
    }
  }
}

__global__ void unpack_kernel(const PackedGradient* packed, std::int64_t n, ChannelChunk chunk,
                              RasterizeGradients<float> out) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i >= n) return;
  const float4 a = packed[i].quads[0], b = packed[i].quads[1], c = packed[i].quads[2];
  const float color[4] = {b.z, b.w, c.x, c.y};
  float* v_color = out.v_colors + i * chunk.n_channels + chunk.first;
  for (int k = 0; k < chunk.count; ++k) v_color[k] = color[k];
  const bool add = chunk.first > 0;  // later channels add to what the first ones gave
  const auto store = [add](float* address, float value) { *address = add ? *address + value : value; };
  store(out.v_means2d + 2 * i, a.x);
  store(out.v_means2d + 2 * i + 1, a.y);
  store(out.v_conics + 3 * i, a.z);
  store(out.v_conics + 3 * i + 1, a.w);
  store(out.v_conics + 3 * i + 2, b.x);
  store(out.v_opacities + i, b.y);
  if (out.v_means2d_abs) {
    out.v_means2d_abs[2 * i] = c.z;
    out.v_means2d_abs[2 * i + 1] = c.w;
  }
}

__global__ void iota_kernel(std::int32_t* values, std::int64_t n) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i < n) values[i] = static_cast<std::int32_t>(i);
}

// Adds each row's entries in the order of the list of all tiles.
__global__ void sum_entries_kernel(const std::int32_t* sorted_rows, const std::int32_t* entries,
                                   std::int64_t n, const PackedGradient* entry_gradients,
                                   PackedGradient* row_gradients) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i >= 3 * n) return;
  const int quad = static_cast<int>(i % 3);
  std::int64_t at = i / 3;
  const std::int32_t row = sorted_rows[at];
  if (at > 0 && sorted_rows[at - 1] == row) return;
  float4 sum{0.f, 0.f, 0.f, 0.f};
  for (; at < n && sorted_rows[at] == row; ++at) {
    const float4 part = entry_gradients[entries[at]].quads[quad];
    sum = {sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w};
  }
  row_gradients[row].quads[quad] = sum;
}

template <int TILE, int CHANNELS, bool ABSOLUTE, bool DETERMINISTIC>
void launch_backward(const BackwardArguments& args, CudaStream stream) {
  const auto kernel = backward_kernel<TILE, CHANNELS, ABSOLUTE, DETERMINISTIC>;
  constexpr int kBytes = sizeof(BackwardShared<TILE, DETERMINISTIC>);
  check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, kBytes), "rasterize_bwd");
  const auto tiles = static_cast<unsigned>(args.grid.tile_end - args.grid.tile_begin);
  kernel<<<tiles, TILE * TILE, kBytes, stream>>>(args);
  check_launch("rasterize_bwd");
}

template <int TILE>
void dispatch_backward(const BackwardArguments& args, bool absolute, CudaStream stream) {
  if (args.entry_gradients) {
    launch_backward<TILE, 4, true, true>(args, stream);
  } else if (absolute) {
    launch_backward<TILE, 4, true, false>(args, stream);
  } else if (args.chunk.count == 4) {
    launch_backward<TILE, 4, false, false>(args, stream);
  } else {
    launch_backward<TILE, 3, false, false>(args, stream);
  }
}

// Which entries belong to each row, in order.
struct EntriesByRow {
  std::int32_t* rows;
  std::int32_t* entries;
};

EntriesByRow sort_entries(const std::int32_t* isect_rows, std::int64_t n, std::int64_t n_rows,
                          Workspace& workspace, CudaStream stream) {
  if (n > INT32_MAX) {
    throw std::runtime_error(
        "blitzgs::rasterize_bwd: deterministic gradients hold at most 2^31 - 1 intersections, got " +
        std::to_string(n) + "; render fewer views at once or set deterministic=False");
  }
  int bits = 1;
  while (bits < 31 && (std::int64_t{1} << bits) < n_rows) ++bits;
  EntriesByRow sorted{workspace.allocate<std::int32_t>(n), workspace.allocate<std::int32_t>(n)};
  auto* order = workspace.allocate<std::int32_t>(n);
  iota_kernel<<<blocks_for(n, 256), 256, 0, stream>>>(order, n);
  check_launch("rasterize_bwd");
  std::size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, isect_rows, sorted.rows, order, sorted.entries, n, 0,
                                        bits, stream),
        "rasterize_bwd");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceRadixSort::SortPairs(scratch, bytes, isect_rows, sorted.rows, order, sorted.entries, n, 0,
                                        bits, stream),
        "rasterize_bwd");
  return sorted;
}

void check_supported(const RasterizeInput<float>& in, bool absolute) {
  const int size = in.grid.tile_size;
  if (size != 8 && size != 16 && size != 32) {
    throw std::runtime_error("blitzgs::rasterize_bwd: tile_size must be 8, 16 or 32 on CUDA, got " +
                             std::to_string(size));
  }
  if (absolute && in.n_channels > 4) {
    throw std::runtime_error("blitzgs::rasterize_bwd: absgrad takes at most 4 channels on CUDA, got " +
                             std::to_string(in.n_channels));
  }
}

}  // namespace

template <>
void rasterize_bwd<float>(const RasterizeInput<float>& in, const RasterizeSaved<float>& saved,
                          std::int64_t n_isects, const void* aux, bool deterministic,
                          const RasterizeGradients<float>& gradients, Workspace& workspace,
                          CudaStream stream) {
  if (in.n_rows == 0) return;
  const bool absolute = gradients.v_means2d_abs != nullptr;
  check_supported(in, absolute);
  const bool empty = n_isects == 0 || in.grid.tile_end <= in.grid.tile_begin;
  const std::size_t row_bytes = static_cast<std::size_t>(in.n_rows) * sizeof(PackedGradient);
  auto* packed = static_cast<PackedGradient*>(workspace.allocate_bytes(row_bytes));
  EntriesByRow sorted{};
  PackedGradient* entries = nullptr;
  const std::size_t entry_bytes = static_cast<std::size_t>(n_isects) * sizeof(PackedGradient);
  if (deterministic && !empty) {
    entries = static_cast<PackedGradient*>(workspace.allocate_bytes(entry_bytes));
    sorted = sort_entries(in.isect_rows, n_isects, in.n_rows, workspace, stream);
  }
  for (int first = 0; first < in.n_channels; first += 4) {
    const ChannelChunk chunk{in.n_channels <= 4 ? aux_colors(aux, in.n_rows) : nullptr, in.colors,
                             in.n_channels, first, std::min(4, in.n_channels - first)};
    check(cudaMemsetAsync(packed, 0, row_bytes, stream), "rasterize_bwd");
    if (!empty) {
      if (entries) check(cudaMemsetAsync(entries, 0, entry_bytes, stream), "rasterize_bwd");
      const BackwardArguments args{aux_rows(aux), chunk, in.backgrounds, in.isect_rows, in.tile_offsets,
                                   in.grid,       saved, packed,         entries};
      if (in.grid.tile_size == 8) {
        dispatch_backward<8>(args, absolute, stream);
      } else if (in.grid.tile_size == 16) {
        dispatch_backward<16>(args, absolute, stream);
      } else {
        dispatch_backward<32>(args, absolute, stream);
      }
      if (entries) {
        sum_entries_kernel<<<blocks_for(3 * n_isects, 256), 256, 0, stream>>>(sorted.rows, sorted.entries,
                                                                              n_isects, entries, packed);
        check_launch("rasterize_bwd");
      }
    }
    unpack_kernel<<<blocks_for(in.n_rows, 256), 256, 0, stream>>>(packed, in.n_rows, chunk, gradients);
    check_launch("rasterize_bwd");
  }
}

}  // namespace blitzgs::cuda
