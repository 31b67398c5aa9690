// SPDX-License-Identifier: Apache-2.0
// The Morton frame (morton.h) of a cloud of points, computed on the GPU so that the host need not wait for
// it.
#pragma once
#include <cstdint>

#include "common/cuda.cuh"
#include "common/kernel.h"
#include "math/morton.h"

namespace blitzgs::cuda {

// Maps floats to integers of the same order, so that atomicMin and atomicMax find the bounds of the cloud.
__device__ inline std::int32_t ordered(float x) {
  const std::int32_t bits = __float_as_int(x);
  return bits < 0 ? bits ^ 0x7fffffff : bits;
}
__device__ inline float unordered(std::int32_t bits) {
  return __int_as_float(bits < 0 ? bits ^ 0x7fffffff : bits);
}

struct MortonBounds {
  std::int32_t low[3], high[3];
  std::int32_t finite;  // number of finite points
};

// Sets the bounds to those of no points. One warp.
static __global__ void reset_bounds(MortonBounds* bounds) {
  const int axis = threadIdx.x;
  if (axis < 3) bounds->low[axis] = INT32_MAX, bounds->high[axis] = INT32_MIN;
  if (axis == 3) bounds->finite = 0;
}

// Finds the bounding box and the number of the finite points of points [n, 3]. One thread per point, in a
// grid-stride loop.
static __global__ void find_bounds(const float* points, std::int64_t n, MortonBounds* bounds) {
  std::int32_t low[3] = {INT32_MAX, INT32_MAX, INT32_MAX}, high[3] = {INT32_MIN, INT32_MIN, INT32_MIN},
               finite = 0;
  for (std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x; i < n;
       i += std::int64_t{gridDim.x} * blockDim.x) {
    const float* p = points + 3 * i;
    if (!is_finite_point(p)) continue;
    ++finite;
    for (int axis = 0; axis < 3; ++axis) {
      low[axis] = min(low[axis], ordered(p[axis]));
      high[axis] = max(high[axis], ordered(p[axis]));
    }
  }
  finite = __reduce_add_sync(kFullWarp, finite);
  for (int axis = 0; axis < 3; ++axis) {
    const std::int32_t l = __reduce_min_sync(kFullWarp, low[axis]),
                       h = __reduce_max_sync(kFullWarp, high[axis]);
    if (threadIdx.x % 32 == 0) {
      atomicMin(&bounds->low[axis], l);
      atomicMax(&bounds->high[axis], h);
    }
  }
  if (threadIdx.x % 32 == 0) atomicAdd(&bounds->finite, finite);
}

__device__ inline MortonFrame frame_of(const MortonBounds& bounds) {
  double low[3], high[3];
  for (int axis = 0; axis < 3; ++axis) {
    low[axis] = unordered(bounds.low[axis]);
    high[axis] = unordered(bounds.high[axis]);
  }
  return make_morton_frame(low, high);
}

inline MortonBounds* find_morton_bounds(const float* points, std::int64_t n, Workspace& workspace,
                                        cudaStream_t stream) {
  MortonBounds* bounds = workspace.allocate<MortonBounds>(1);
  reset_bounds<<<1, 32, 0, stream>>>(bounds);
  find_bounds<<<std::min(blocks_for(n, 256), 1024u), 256, 0, stream>>>(points, n, bounds);
  check_launch("morton bounds");
  return bounds;
}

}  // namespace blitzgs::cuda
