// SPDX-License-Identifier: Apache-2.0
// Compositing a pixel on CUDA: one definition for the image and for the contributions of splats, so that both
// see the same alpha T, bit for bit.
#pragma once
#include <cstdint>

#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

// List entries that a block copies at once.
inline constexpr int kForwardBatch = 256;

// Alpha T of four entries of a batch at a pixel: zero where an entry is not composited.
struct QuadWeights {
  float at[4];
  bool touched[4];
};

// One pixel's state while its list is composited. Entries are named by their offset in the batch.
struct Compositor {
  static constexpr std::uint32_t kNone = ~0u;
  float transmittance = 1.f;
  float limit;                  // least log2(alpha) that still counts: infinite once the pixel has ended
  std::uint32_t last = kNone;   // composited last
  std::uint32_t ended = kNone;  // at which the pixel ended

  // Composites four entries of a batch. Whether the pixel ends is asked once for all of them.
  __device__ __forceinline__ QuadWeights add(const char* entries, const QuadOffsets& offsets,
                                             const Pixel& pixel) {
    float alpha[4];
    QuadWeights weights;
    float after = transmittance;
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const float log2_a = log2_alpha(entry_at(entries, offsets.at[k]), pixel);
      weights.touched[k] = log2_a >= limit;
      alpha[k] = weights.touched[k] ? fminf(exp2_approx(log2_a), static_cast<float>(kAlphaMax)) : 0.f;
      after = __fmaf_rn(-alpha[k], after, after);
    }
    if (__any_sync(kFullWarp, after < static_cast<float>(kMinTransmittance))) {
      end(alpha, weights.touched, offsets);
    }
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      weights.at[k] = alpha[k] * transmittance;
      transmittance = __fmaf_rn(-alpha[k], transmittance, transmittance);
      if (weights.touched[k]) last = offsets.at[k];
    }
    return weights;
  }

  // Takes the entry that would end the pixel, and those behind it, out of the four.
  __device__ __forceinline__ void end(float (&alpha)[4], bool (&touched)[4], const QuadOffsets& offsets) {
    float after = transmittance;
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      after = __fmaf_rn(-alpha[k], after, after);
      if (ended == kNone && after < static_cast<float>(kMinTransmittance)) ended = offsets.at[k];
      if (ended != kNone) {
        alpha[k] = 0.f;
        touched[k] = false;
        limit = INFINITY;
      }
    }
  }

  __device__ __forceinline__ bool done() const { return limit == INFINITY; }
};

}  // namespace blitzgs::cuda
