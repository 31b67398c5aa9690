// SPDX-License-Identifier: Apache-2.0
// From the two numbers of each (entry, pixel) that the backward pass leaves in shared memory, the weight
// alpha T and g = dL/d(ln alpha), to an entry's gradients: sums of the weights against the pixels' gradients,
// and moments of g over the pixel grid, from which the gradients of mean and conic follow.
#pragma once
#include "common/branches.cuh"
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

inline constexpr int kGroup = 16;  // entries transposed at a time, one for each lane of a half-warp
// float2 per entry: its pixels, and a pad that spreads the entries over the banks.
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

// Gradients of a subtile's pixels, channel by channel.
template <int CHANNELS>
struct __align__(16) SubtileGradient {
  float v[CHANNELS][kSubtile * kSubtile];
};

// Sums of one entry over pixels: weights times v_render, moments of g about the subtile's centre, and
// |gradient of the mean|.
template <int CHANNELS>
struct EntrySums {
  float color[CHANNELS] = {};
  float g = 0.f, gx = 0.f, gy = 0.f, gxx = 0.f, gxy = 0.f, gyy = 0.f;
  float abs_x = 0.f, abs_y = 0.f;
};

// Sums over four values at the offsets -1.5, -0.5, 0.5 and 1.5.
struct Moments {
  float zeroth, first, second;
  __device__ __forceinline__ Moments(float a, float b, float c, float d) {
    const float outer = a + d, inner = b + c;
    zeroth = outer + inner;
    first = 1.5f * (d - a) + 0.5f * (c - b);
    second = 2.25f * outer + 0.25f * inner;
  }
};

// x and y: the subtile's centre from the entry's mean.
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
        const float dx = x + (static_cast<float>(column) - 1.5f), dy = y + (static_cast<float>(row) - 1.5f);
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

// Moments about the subtile's centre to gradients of the splat.
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

}  // namespace blitzgs::cuda
