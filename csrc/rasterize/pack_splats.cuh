// SPDX-License-Identifier: Apache-2.0
// What comes before compositing on CUDA: splats packed as the kernels read them, and the order of the tiles.
#pragma once
#include <cstdint>

#include "common/launch.cuh"
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

inline constexpr int kPackThreads = 256;

__device__ __forceinline__ PackedSplat pack_splat(const RasterizeInput<float>& in, std::int64_t i) {
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
  const float width = sqrtf(conic[2] / static_cast<float>(conic_determinant(conic)));
  splat.turn = conic[1] == 0.f ? 0.f : -(conic[1] / conic[2]) * (width / kFactorScale);
  return splat;
}

// The last blocks order the tiles; the others pack splats. A warp's splats go through shared memory, so that
// each store fills whole sectors.
inline __global__ void __launch_bounds__(kPackThreads, 8)
    prepare_kernel(RasterizeInput<float> in, PackedSplat* splats, float4* colors, TileOrder order) {
  wait_for_earlier_kernels();
  const auto pack_blocks = static_cast<unsigned>((in.n_splats + kPackThreads - 1) / kPackThreads);
  if (blockIdx.x >= pack_blocks) {
    order.add(in.tile_offsets, static_cast<int>((blockIdx.x - pack_blocks) * kPackThreads + threadIdx.x));
    return;
  }
  const std::int64_t n = splats_there(in);
  __shared__ PackedSplat stages[kPackThreads];
  const PackedSplat* stage = stages + threadIdx.x / 32 * 32;
  const int lane = threadIdx.x % 32;
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kPackThreads) + threadIdx.x;
  if (i < n) stages[threadIdx.x] = pack_splat(in, i);
  __syncwarp();
#pragma unroll
  for (int k = 0; k < 2; ++k) {
    const std::int64_t at = 2 * (i - lane) + 32 * k + lane;
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

// Packs the splats of an input, and their colours unless null, and orders the tiles; `what` is named where it
// fails.
inline void prepare(const char* what, const RasterizeInput<float>& in, PackedSplat* splats, float4* colors,
                    const TileOrder& order, CudaStream stream) {
  order.clear(stream);
  const unsigned blocks = blocks_for(in.n_splats, kPackThreads) + blocks_for(order.unordered(), kPackThreads);
  if (blocks > 0)
    launch_early(what, prepare_kernel, {blocks, kPackThreads, stream}, in, splats, colors, order);
}

}  // namespace blitzgs::cuda
