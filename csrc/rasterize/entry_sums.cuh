// SPDX-License-Identifier: Apache-2.0
// From the two numbers of each (entry, pixel) that the backward pass leaves in shared memory, the weight
// alpha T and g = dL/d(ln alpha), to an entry's gradients: sums of the weights against the pixels' gradients,
// and moments of g over the pixel grid, from which the gradients of mean and conic follow.
#pragma once
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

inline constexpr int kGroup = 16;            // entries transposed at a time
inline constexpr int kGroupStride = 32 + 1;  // float2 per entry; odd, so that columns spread over the banks

__device__ __forceinline__ void add_quad(float* address, float a, float b, float c, float d) {
#if __CUDA_ARCH__ >= 900
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

__device__ __forceinline__ float add_halves(float value) {
  return value + __shfl_xor_sync(kFullWarp, value, kGroup);
}

// Sums of one entry over pixels: weights times v_render, moments of g about the subtile's centre, and
// |gradient of the mean|.
template <int CHANNELS>
struct EntrySums {
  float color[CHANNELS] = {};
  float g = 0.f, gx = 0.f, gy = 0.f, gxx = 0.f, gxy = 0.f, gyy = 0.f;
  float abs_x = 0.f, abs_y = 0.f;
};

// The two pixel rows of this half of the subtile.
template <int CHANNELS, bool ABSOLUTE>
__device__ __forceinline__ EntrySums<CHANNELS> sum_half(const float2* group, const float4* v_render,
                                                        const Entry& shape, float centre_x, float centre_y,
                                                        int half) {
  EntrySums<CHANNELS> sums;
#pragma unroll
  for (int y = 0; y < 2; ++y) {
    const float offset_y = static_cast<float>(2 * half + y) - 1.5f;
    float g0 = 0.f, g1 = 0.f, g2 = 0.f;
#pragma unroll
    for (int x = 0; x < kSubtileWidth; ++x) {
      const int pixel = half * 16 + y * kSubtileWidth + x;
      const float offset_x = static_cast<float>(x) - 3.5f;
      const float2 value = group[pixel];
      const float4 v = v_render[pixel];
#pragma unroll
      for (int k = 0; k < CHANNELS; ++k) sums.color[k] += value.x * channel(v, k);
      g0 += value.y;
      g1 += value.y * offset_x;
      g2 += value.y * (offset_x * offset_x);
      if constexpr (ABSOLUTE) {
        const float dx = centre_x + offset_x - shape.x, dy = centre_y + offset_y - shape.y;
        const float u = shape.l11 * dx + shape.l21 * dy, w = shape.l22 * dy;
        sums.abs_x += fabsf(value.y * (shape.l11 * u));
        sums.abs_y += fabsf(value.y * (shape.l21 * u + shape.l22 * w));
      }
    }
    sums.g += g0;
    sums.gx += g1;
    sums.gxx += g2;
    sums.gy += g0 * offset_y;
    sums.gxy += g1 * offset_y;
    sums.gyy += g0 * (offset_y * offset_y);
  }
  return sums;
}

// Moments about the subtile's centre to gradients of the row.
template <int CHANNELS, bool ABSOLUTE>
__device__ __forceinline__ PackedGradient finish(const EntrySums<CHANNELS>& s, const Entry& shape,
                                                 float centre_x, float centre_y) {
  const float x = centre_x - shape.x, y = centre_y - shape.y;
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
