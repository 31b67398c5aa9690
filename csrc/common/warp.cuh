// SPDX-License-Identifier: Apache-2.0
// What the lanes of a warp do together.
#pragma once

namespace blitzgs::cuda {

inline constexpr unsigned kFullWarp = 0xffffffffu;  // all lanes take part

template <class T>
__device__ __forceinline__ T sum_of_lanes_until(T value, int lane) {
#pragma unroll
  for (int step = 1; step < 32; step *= 2) {
    const T before = __shfl_up_sync(kFullWarp, value, step);
    if (lane >= step) value += before;
  }
  return value;
}

}  // namespace blitzgs::cuda
