// SPDX-License-Identifier: Apache-2.0
// A pixel of the backward pass: from an entry, the two numbers that its gradients are summed from.
#pragma once
#include "rasterize/entry_sums.cuh"

namespace blitzgs::cuda {

__device__ __noinline__ inline float wide_dot(const float* v, const float* color, int n) {
  float sum = 0.f;
  for (int k = 0; k < n; ++k) sum = __fmaf_rn(v[k], color[k], sum);
  return sum;
}

// One pixel's state while its list is walked from the back.
template <int CHANNELS>
struct BackwardPixel {
  float transmittance;  // in front of the entries walked so far
  float behind;         // v . (what lies behind, background included)
  float v[CHANNELS];

  // Four entries: writes weight and g of each to slots[k * kGroupStride]. last: offset in the batch from
  // which on the pixel has composited nothing. dot(entry): v . color.
  template <class Batch, class Dot>
  __device__ __forceinline__ void add(const Batch& batch, const std::uint32_t (&offsets)[4],
                                      std::uint32_t last, const Pixel& pixel, const Dot& dot, float2* slots) {
    float raw[4], dots[4];
    bool touched[4];
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const float log2_a = log2_alpha(batch.at(offsets[k]), pixel);
      raw[k] = exp2_approx(log2_a);
      touched[k] = log2_a >= kLog2Cut && offsets[k] < last;
      dots[k] = dot(offsets[k]);
    }
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const float alpha = touched[k] ? fminf(raw[k], static_cast<float>(kAlphaMax)) : 0.f;
      const float inverse = reciprocal_approx(1.f - alpha);
      transmittance *= inverse;
      const float weight = alpha * transmittance;
      const float v_alpha = __fmaf_rn(transmittance, dots[k], -behind * inverse);
      if (touched[k])
        behind = __fmaf_rn(weight, dots[k], behind);  // not 0 * NaN where the row's color is NaN
      const bool differentiable = touched[k] && raw[k] <= static_cast<float>(kAlphaMax);
      slots[k * kGroupStride] = {weight, differentiable ? v_alpha * alpha : 0.f};
    }
  }
};

}  // namespace blitzgs::cuda
