// SPDX-License-Identifier: Apache-2.0
// The steps of the CUDA backward pass from the gradient of a pixel to the gradients of splats: per entry and
// pixel (BackwardPixel), per entry (sum_pixels, finish), per splat (sum_entries_kernel for deterministic
// gradients), and from the packed table to one array per input (unpack_kernel). rasterize.h has the formulas.
// BackwardPixel leaves w and g of each pair of an entry and a pixel in shared memory. The sums over g dx,
// g dx^2 and so on are moments of g over the pixel grid.
#pragma once
#include <cub/device/device_radix_sort.cuh>

#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

// A half-warp transposes this many entries at a time: first a lane is a pixel, then a lane is an entry.
inline constexpr int kGroup = 16;
// float2 values per entry: one for each pixel, and two of padding so that entries lie in different banks.
inline constexpr int kGroupStride = kSubtile * kSubtile + 2;

__device__ __forceinline__ void add_quad(float* address, float a, float b, float c, float d) {
#if BLITZGS_SM90
  asm volatile("red.relaxed.gpu.global.add.v4.f32 [%0], {%1, %2, %3, %4};" ::"l"(address), "f"(a), "f"(b),
               "f"(c), "f"(d)
               : "memory");
#else
  atomicAdd(address, a);
  atomicAdd(address + 1, b);
  atomicAdd(address + 2, c);
  atomicAdd(address + 3, d);
#endif
}

// The gradients of the loss by the colours of a subtile's pixels, channel by channel.
template <int CHANNELS> struct __align__(16) SubtileGradient {
  float v[CHANNELS][kSubtile * kSubtile];
};

// The sums of one entry over the pixels of a subtile: weights times v_render (the colour's gradient), the
// moments of g about the subtile's centre, and the absolute values of the mean's gradient (absgrad).
template <int CHANNELS> struct EntrySums {
  float color[CHANNELS] = {};
  float g = 0.f, gx = 0.f, gy = 0.f, gxx = 0.f, gxy = 0.f, gyy = 0.f;
  float abs_x = 0.f, abs_y = 0.f;
};

// The moments of order 0, 1 and 2 of four values at the offsets -1.5, -0.5, 0.5 and 1.5.
struct Moments {
  float zeroth, first, second;
  __device__ __forceinline__ Moments(float a, float b, float c, float d) {
    const float outer = a + d, inner = b + c;
    zeroth = outer + inner;
    first = 1.5f * (d - a) + 0.5f * (c - b);
    second = 2.25f * outer + 0.25f * inner;
  }
};

// Computes the sums of one entry over the 16 pixels of a subtile. group: weight and g of each pixel. (x, y):
// from the entry's mean to the subtile's centre.
template <int CHANNELS, bool ABSOLUTE>
__device__ __forceinline__ EntrySums<CHANNELS> sum_pixels(const float2* group,
                                                          const SubtileGradient<CHANNELS>& gradient,
                                                          const Entry& shape, float x, float y) {
  EntrySums<CHANNELS> sums;
  float zeroth[kSubtile], first[kSubtile];
#pragma unroll
  for (int row = 0; row < kSubtile; ++row) {
    const float4 left = reinterpret_cast<const float4*>(group)[2 * row];
    const float4 right = reinterpret_cast<const float4*>(group)[2 * row + 1];
#pragma unroll
    for (int k = 0; k < CHANNELS; ++k) {
      const float4 v = reinterpret_cast<const float4*>(gradient.v[k])[row];
      sums.color[k] += left.x * v.x + left.z * v.y + right.x * v.z + right.z * v.w;
    }
    const Moments moments(left.y, left.w, right.y, right.w);
    zeroth[row] = moments.zeroth;
    first[row] = moments.first;
    sums.gxx += moments.second;
    if constexpr (ABSOLUTE) {
      const float g[kSubtile] = {left.y, left.w, right.y, right.w};
#pragma unroll
      for (int column = 0; column < kSubtile; ++column) {
        const float dx = x + (float(column) - 1.5f), dy = y + (float(row) - 1.5f);
        const float u = shape.l11 * dx + shape.l21 * dy, w = shape.l22 * dy;
        sums.abs_x += fabsf(g[column] * (shape.l11 * u));
        sums.abs_y += fabsf(g[column] * (shape.l21 * u + shape.l22 * w));
      }
    }
  }
  const Moments columns(zeroth[0], zeroth[1], zeroth[2], zeroth[3]);
  const Moments mixed(first[0], first[1], first[2], first[3]);
  sums.g = columns.zeroth;
  sums.gy = columns.first;
  sums.gyy = columns.second;
  sums.gx = mixed.zeroth;
  sums.gxy = mixed.first;
  return sums;
}

// Turns the sums of an entry over a subtile into the entry's contribution to the splat's gradients: shifts
// the moments of g to the mean, and multiplies by the conic (a, b, c) for the mean's gradient.
template <int CHANNELS, bool ABSOLUTE>
__device__ __forceinline__ PackedGradient finish(const EntrySums<CHANNELS>& s, const Entry& shape, float x,
                                                 float y) {
  const float mx = s.gx + x * s.g, my = s.gy + y * s.g;
  const float mxx = s.gxx + x * (2.f * s.gx + x * s.g);
  const float mxy = s.gxy + x * s.gy + y * (s.gx + x * s.g);
  const float myy = s.gyy + y * (2.f * s.gy + y * s.g);
  const float a = kInverseScale2 * shape.l11 * shape.l11, b = kInverseScale2 * shape.l11 * shape.l21;
  const float c = kInverseScale2 * (shape.l21 * shape.l21 + shape.l22 * shape.l22);
  PackedGradient gradient;
  gradient.quads[0] = {a * mx + b * my, b * mx + c * my, -0.5f * mxx, -mxy};
  gradient.quads[1] = {-0.5f * myy, s.g * exp2_approx(-shape.log2_opacity), s.color[0], s.color[1]};
  gradient.quads[2] = {s.color[2], CHANNELS > 3 ? s.color[CHANNELS - 1] : 0.f,
                       ABSOLUTE ? kInverseScale2 * s.abs_x : 0.f, ABSOLUTE ? kInverseScale2 * s.abs_y : 0.f};
  return gradient;
}

// The state of one pixel while the backward pass visits its list from the last entry to the first.
template <int CHANNELS> struct BackwardPixel {
  float transmittance;  // in front of the entries visited so far
  float behind;         // v . (the colour of those entries and the background, as seen with T = 1)
  float v[CHANNELS];    // the gradient of the loss by the pixel's colour

  // Visits four entries of a batch and writes the weight and g of each to slots[k * kGroupStride]. last: the
  // forward pass composited no entry of this offset or a higher one. dot(offset): v . colour of the entry.
  template <class Dot>
  __device__ __forceinline__ void add(const char* entries, const QuadOffsets& offsets, uint32_t last,
                                      const Pixel& pixel, const Dot& dot, float2* slots) {
    float raw[4], dots[4];
    bool touched[4];
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const float log2_a = log2_alpha(entry_at(entries, offsets.at[k]), pixel);
      raw[k] = exp2_approx(log2_a);
      touched[k] = log2_a >= kLog2Cut && offsets.at[k] < last;
      dots[k] = dot(offsets.at[k]);
    }
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const float alpha = touched[k] ? fminf(raw[k], float(kAlphaMax)) : 0.f;
      transmittance *= reciprocal_approx(1.f - alpha);
      const float weight = alpha * transmittance;
      const float difference = dots[k] - behind;
      if (touched[k]) behind = __fmaf_rn(alpha, difference, behind);  // the test avoids 0 * NaN
      const bool differentiable = touched[k] && raw[k] <= float(kAlphaMax);
      slots[k * kGroupStride] = {weight, differentiable ? weight * difference : 0.f};
    }
  }
};

// Deterministic gradients: a stable sort groups the list entries by splat, and sum_entries_kernel adds the
// gradients of a splat's entries in the order of the list.

inline __global__ void iota_kernel(int32_t* values, int64_t n) {
  const int64_t i = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
  if (i < n) values[i] = int32_t(i);
}

// splat_gradients[splat] = the sum of entry_gradients over the splat's entries, in the order of the list of
// all tiles. Three threads for each of the n sorted entries, one per quad of the gradient; the threads of a
// splat's first entry sum over all its entries. Entries from *n_listed on belong to no tile, and their splats
// are unspecified. The stable sort puts them after the listed entries of the same splat, so the sum ends at
// the first of them.
inline __global__ void sum_entries_kernel(const int32_t* sorted_splats, const int32_t* entries, int64_t n,
                                          const int64_t* n_listed, const PackedGradient* entry_gradients,
                                          PackedGradient* splat_gradients) {
  const int64_t i = blockIdx.x * int64_t(blockDim.x) + threadIdx.x;
  if (i >= 3 * n) return;
  const int quad = int(i % 3);
  int64_t at = i / 3;
  const int64_t end = *n_listed;
  const int32_t splat = sorted_splats[at];
  if (entries[at] >= end || (at > 0 && sorted_splats[at - 1] == splat)) return;
  float4 sum{0.f, 0.f, 0.f, 0.f};
  for (; at < n && sorted_splats[at] == splat && entries[at] < end; ++at) {
    const float4 part = entry_gradients[entries[at]].quads[quad];
    sum = {sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w};
  }
  splat_gradients[splat].quads[quad] = sum;
}

// The list entries sorted by splat: the splat and the position in the list of each, [n].
struct EntriesBySplat {
  int32_t *splats, *entries;
};

inline EntriesBySplat sort_entries(const int32_t* isect_splats, int64_t n, int64_t n_splats,
                                   Workspace& workspace, CudaStream stream) {
  if (n > INT32_MAX) {
    throw std::runtime_error(
        "blitzgs::rasterize_bwd: deterministic gradients hold at most 2^31 - 1 intersections, got " +
        std::to_string(n) + "; render fewer views at once or set deterministic=False");
  }
  int bits = 1;
  while (bits < 31 && (int64_t{1} << bits) < n_splats) ++bits;
  EntriesBySplat sorted{workspace.allocate<int32_t>(n), workspace.allocate<int32_t>(n)};
  auto* order = workspace.allocate<int32_t>(n);
  iota_kernel<<<blocks_for(n, 256), 256, 0, stream>>>(order, n);
  check_launch("rasterize_bwd");
  run_cub("rasterize_bwd", workspace, [&](void* scratch, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(scratch, bytes, isect_splats, sorted.splats, order, sorted.entries,
                                           n, 0, bits, stream);
  });
  return sorted;
}

inline constexpr int kUnpackThreads = 256;

// Writes the WIDTH floats of each of the warp's first n_splats lanes to out [n_splats, WIDTH], or adds them.
// The floats go through shared memory, so that each store fills whole sectors.
template <int WIDTH>
__device__ __forceinline__ void store_splats(float* stage, const float (&mine)[WIDTH], float* out,
                                             int n_splats, bool add) {
  const int lane = threadIdx.x % 32;
#pragma unroll
  for (int k = 0; k < WIDTH; ++k) stage[WIDTH * lane + k] = mine[k];
  __syncwarp();
#pragma unroll
  for (int k = 0; k < WIDTH; ++k) {
    const int at = 32 * k + lane;
    if (at < WIDTH * n_splats) out[at] = add ? out[at] + stage[at] : stage[at];
  }
  __syncwarp();
}

// Writes the packed gradients [n] to one array per input: v_colors, v_means2d, v_conics, v_opacities and, if
// wanted, v_means2d_abs. One thread per splat. The first chunk of channels writes, later chunks add.
// colors_only: the first chunk gave the complete gradients of everything but the colours.
inline __global__ void unpack_kernel(const PackedGradient* packed, int64_t n, ChannelChunk chunk,
                                     bool colors_only, RasterizeGradients<float> out) {
  __shared__ float4 stages[kUnpackThreads / 32][3 * 32];
  wait_for_earlier_kernels();
  float4* stage = stages[threadIdx.x / 32];
  const int lane = threadIdx.x % 32;
  const int64_t i = blockIdx.x * int64_t(kUnpackThreads) + threadIdx.x;
  const int64_t first = i - lane;  // the first splat of the warp
  const int n_splats = int(min(max(n - first, int64_t{0}), int64_t{32}));
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    const int at = 32 * k + lane;
    if (at < 3 * n_splats) stage[at] = reinterpret_cast<const float4*>(packed)[3 * first + at];
  }
  __syncwarp();
  const float4 a = stage[3 * lane], b = stage[3 * lane + 1], c = stage[3 * lane + 2];
  __syncwarp();
  float* floats = reinterpret_cast<float*>(stage);
  if (chunk.n_channels == 3) {
    store_splats<3>(floats, {b.z, b.w, c.x}, out.v_colors + 3 * first, n_splats, false);
  } else if (i < n) {
    const float color[4] = {b.z, b.w, c.x, c.y};
    for (int k = 0; k < chunk.count; ++k) out.v_colors[i * chunk.n_channels + chunk.first + k] = color[k];
  }
  if (colors_only) return;
  const bool add = chunk.first > 0;
  store_splats<2>(floats, {a.x, a.y}, out.v_means2d + 2 * first, n_splats, add);
  store_splats<3>(floats, {a.z, a.w, b.x}, out.v_conics + 3 * first, n_splats, add);
  store_splats<1>(floats, {b.y}, out.v_opacities + first, n_splats, add);
  if (out.v_means2d_abs) store_splats<2>(floats, {c.z, c.w}, out.v_means2d_abs + 2 * first, n_splats, false);
}

}  // namespace blitzgs::cuda
