// SPDX-License-Identifier: Apache-2.0
// From gradients packed by splat to one array for each input.
#pragma once
#include "common/launch.cuh"
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

inline constexpr int kUnpackThreads = 256;

// Stores the WIDTH floats of each of the warp's first n_splats lanes to consecutive memory. By way of
// shared memory, because a store that skips over others' floats fills no sector.
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

// colors_only: an earlier chunk gave the gradient of everything else.
inline __global__ void unpack_kernel(const PackedGradient* packed, std::int64_t n, ChannelChunk chunk,
                                     bool colors_only, RasterizeGradients<float> out) {
  __shared__ float4 stages[kUnpackThreads / 32][3 * 32];
  wait_for_earlier_kernels();
  float4* stage = stages[threadIdx.x / 32];
  const int lane = threadIdx.x % 32;
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kUnpackThreads) + threadIdx.x;
  const std::int64_t first = i - lane;  // of the warp's splats
  const int n_splats = static_cast<int>(min(max(n - first, std::int64_t{0}), std::int64_t{32}));
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
  const bool add = chunk.first > 0;  // later channels add to what the first ones gave
  store_splats<2>(floats, {a.x, a.y}, out.v_means2d + 2 * first, n_splats, add);
  store_splats<3>(floats, {a.z, a.w, b.x}, out.v_conics + 3 * first, n_splats, add);
  store_splats<1>(floats, {b.y}, out.v_opacities + first, n_splats, add);
  if (out.v_means2d_abs) store_splats<2>(floats, {c.z, c.w}, out.v_means2d_abs + 2 * first, n_splats, false);
}

}  // namespace blitzgs::cuda
