// SPDX-License-Identifier: Apache-2.0
// The scatter of splats to the ranks that need them, packed for a collective (scatter_cuda.cu) or written to
// the memory of peers (transport_cuda.cu). For each rank and column a warp writes one run of words, in whole
// memory transactions except at its ends, so that a write across a link takes few packets. Blocks agree on
// the positions of their runs with one atomic addition per block and rank.
#pragma once
#include "common/cuda.cuh"
#include "exchange/scatter.h"

namespace blitzgs::cuda {

inline constexpr int kScatterWarps = kScatterBlock / 32;
static_assert(kPlaceSplats == 32, "a warp's splats are a run");

struct ScatterState {
  int64_t* filled;     // the number of positions of each group that blocks have taken; zero at the start
  SplatPlace* places;  // the output of scatter

  __device__ int64_t take(int m, int count) const { return count == 0 ? 0 : atomic_add(filled + m, count); }
};

// The number of words between the last multiple of 128 bytes and an address. A warp that starts so many words
// before the address stores whole 128-byte transactions.
__device__ __forceinline__ int words_past_line(const void* address) {
  return int(reinterpret_cast<std::uintptr_t>(address) / 4 % 32);
}

// A warp copies the `n` listed splats of one column to consecutive memory. Each lane has kAhead loads in
// flight, because the values come from the second-level cache at best.
template <int WIDTH>
__device__ __forceinline__ void copy_run(const int32_t* from, const uint8_t* list, int n, int any_width,
                                         int32_t* to) {
  constexpr int kAhead = 4;
  const int width = WIDTH > 0 ? WIDTH : any_width, words = n * width;
  for (int first = int(threadIdx.x % 32) - words_past_line(to); first < words; first += 32 * kAhead) {
    int32_t values[kAhead];
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      const int i = first + 32 * k, splat = i / width;
      if (i >= 0 && i < words) values[k] = from[list[splat] * width + (i - splat * width)];
    }
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      const int i = first + 32 * k;
      if (i >= 0 && i < words) to[i] = values[k];
    }
  }
}

__device__ __forceinline__ void copy_run(const int32_t* from, const uint8_t* list, int n, int width,
                                         int32_t* to) {
  switch (width) {
    case 1:
      return copy_run<1>(from, list, n, width, to);
    case 2:
      return copy_run<2>(from, list, n, width, to);
    case 3:
      return copy_run<3>(from, list, n, width, to);
    default:
      return copy_run<0>(from, list, n, width, to);
  }
}

}  // namespace blitzgs::cuda
