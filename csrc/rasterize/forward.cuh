// SPDX-License-Identifier: Apache-2.0
// Code that two CUDA passes share: the forward pass of the rasteriser (rasterize_fwd_cuda.cu) and the
// contributions of splats (importance_cuda.cu). It packs the splats, orders the tiles and composites a pixel.
#pragma once
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

inline constexpr int kPackThreads = 256;

__device__ __forceinline__ PackedSplat pack_splat(const RasterizeInput<float>& in, int64_t i) {
  const float conic[3] = {in.conics[3 * i], in.conics[3 * i + 1], in.conics[3 * i + 2]};
  const ConicFactor<float> factor = factor_conic(conic);
  PackedSplat splat;
  splat.x = in.means2d[2 * i];
  splat.y = in.means2d[2 * i + 1];
  splat.l11 = kFactorScale * factor.l11;
  splat.l21 = kFactorScale * factor.l21;
  splat.l22 = kFactorScale * factor.l22;
  splat.log2_opacity = log2f(in.opacities[i]);
  splat.dx_per_dy = -conic[1] / conic[0];
  const float width = sqrtf(conic[2] / float(conic_determinant(conic)));
  splat.turn = conic[1] == 0.f ? 0.f : -(conic[1] / conic[2]) * (width / kFactorScale);
  return splat;
}

// Prepares compositing: packs the splats [P] and, unless null, their colours [P, 4], one thread per splat,
// and fills in the order of the tiles, one thread per tile in the last blocks. The packed splats of a warp go
// through shared memory, so that each store fills whole sectors.
inline __global__ void __launch_bounds__(kPackThreads, 8)
    prepare_kernel(RasterizeInput<float> in, PackedSplat* splats, float4* colors, TileOrder order) {
  wait_for_earlier_kernels();
  const auto pack_blocks = unsigned((in.n_splats + kPackThreads - 1) / kPackThreads);
  if (blockIdx.x >= pack_blocks) {
    order.add(in.tile_offsets, int((blockIdx.x - pack_blocks) * kPackThreads + threadIdx.x));
    return;
  }
  const int64_t n = valid_splat_count(in);
  __shared__ PackedSplat stages[kPackThreads];
  const PackedSplat* stage = stages + threadIdx.x / 32 * 32;
  const int lane = threadIdx.x % 32;
  const int64_t i = blockIdx.x * int64_t(kPackThreads) + threadIdx.x;
  if (i < n) stages[threadIdx.x] = pack_splat(in, i);
  __syncwarp();
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const int64_t at = 2 * (i - lane) + 32 * k + lane;
    if (at < 2 * n) {
      reinterpret_cast<float4*>(splats)[at] = reinterpret_cast<const float4*>(stage)[32 * k + lane];
    }
  }
  if (!colors || i >= n) return;
  const float* color = in.colors + i * in.n_channels;
  float4 c{color[0], 0.f, 0.f, 0.f};
  if (in.n_channels > 1) c.y = color[1];
  if (in.n_channels > 2) c.z = color[2];
  if (in.n_channels > 3) c.w = color[3];
  colors[i] = c;
}

inline void prepare(const char* what, const RasterizeInput<float>& in, PackedSplat* splats, float4* colors,
                    const TileOrder& order, CudaStream stream) {
  order.clear(stream);
  const unsigned blocks = blocks_for(in.n_splats, kPackThreads) + blocks_for(order.unordered(), kPackThreads);
  if (blocks > 0)
    launch_early(what, prepare_kernel, {blocks, kPackThreads, stream}, in, splats, colors, order);
}

// Compositing a pixel on CUDA (docs/image.md, sections 3 and 5). The image and the contributions of splats
// use the same definition, so both get the same alpha T, bit for bit.

// List entries that a block copies at a time.
inline constexpr int kForwardBatch = 256;

// The alphas of four entries of a batch at a pixel, zero if not composited, and whether they are.
struct QuadAlphas {
  float at[4];
  bool touched[4];
};

// The state of one pixel while its list is composited. For each four entries, alphas() comes first, and then
// composite() of each alpha in order. `ended` is a byte offset of an entry in the current batch. The
// transmittance and the weights are in units of 1 / kScale. It is a power of two, so it changes no rounding.
template <int64_t kScale = 1> struct Compositor {
  static constexpr uint32_t kNone = ~0u;
  static constexpr float kEnd = float(kMinTransmittance) * float(kScale);
  float transmittance = float(kScale);
  float limit;             // the least log2(alpha) that is composited; infinite once the pixel has ended
  uint32_t ended = kNone;  // the entry at which the pixel ended

  // Finds the alphas of four entries of a batch. It tests once for all four whether a pixel of the warp ends.
  __device__ __forceinline__ QuadAlphas alphas(const char* entries, const QuadOffsets& offsets,
                                               const Pixel& pixel) {
    QuadAlphas alpha;
    float after = transmittance;
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      const float log2_a = log2_alpha(entry_at(entries, offsets.at[k]), pixel);
      alpha.touched[k] = log2_a >= limit;
      alpha.at[k] = alpha.touched[k] ? fminf(exp2_approx(log2_a), float(kAlphaMax)) : 0.f;
      after = __fmaf_rn(-alpha.at[k], after, after);
    }
    if (__any_sync(kFullWarp, after < kEnd)) end(alpha, offsets);
    return alpha;
  }

  // Composites an entry: returns its weight alpha T and reduces the transmittance T to (1 - alpha) T.
  __device__ __forceinline__ float composite(float alpha) {
    const float weight = alpha * transmittance;
    transmittance = __fmaf_rn(-alpha, transmittance, transmittance);
    return weight;
  }

  // If one of the four entries ends the pixel, removes this entry and the entries after it.
  __device__ __forceinline__ void end(QuadAlphas& alpha, const QuadOffsets& offsets) {
    float after = transmittance;
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      after = __fmaf_rn(-alpha.at[k], after, after);
      if (ended == kNone && after < kEnd) ended = offsets.at[k];
      if (ended != kNone) {
        alpha.at[k] = 0.f;
        alpha.touched[k] = false;
        limit = INFINITY;
      }
    }
  }

  __device__ __forceinline__ bool done() const { return limit == INFINITY; }
};

}  // namespace blitzgs::cuda
