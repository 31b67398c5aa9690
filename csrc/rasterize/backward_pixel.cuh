// SPDX-License-Identifier: Apache-2.0
// A pixel of the backward pass: from an entry, the two numbers that its gradients are summed from.
#pragma once
#include "rasterize/entry_sums.cuh"

namespace blitzgs::cuda {

// One pixel's state while its list is walked from the back.
template <int CHANNELS>
struct BackwardPixel {
  float transmittance;  // in front of the entries walked so far
  float behind;         // v . (what would be seen behind there, background included)
  float v[CHANNELS];

  // Four entries of a batch: writes weight and g of each to slots[k * kGroupStride]. last: offset from which
  // on the pixel has composited nothing. dot(offset): v . color.
  template <class Dot>
  __device__ __forceinline__ void add(const char* entries, const QuadOffsets& offsets, std::uint32_t last,
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
      const float alpha = touched[k] ? fminf(raw[k], static_cast<float>(kAlphaMax)) : 0.f;
      transmittance *= reciprocal_approx(1.f - alpha);
      const float weight = alpha * transmittance;
      const float difference = dots[k] - behind;
      if (touched[k]) behind = __fmaf_rn(alpha, difference, behind);  // not 0 * NaN where a color is NaN
      const bool differentiable = touched[k] && raw[k] <= static_cast<float>(kAlphaMax);
      slots[k * kGroupStride] = {weight, differentiable ? weight * difference : 0.f};
    }
  }
};

}  // namespace blitzgs::cuda
