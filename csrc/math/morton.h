// SPDX-License-Identifier: Apache-2.0
// Morton (Z-order) codes: points with neighbouring codes lie close together.
#pragma once
#include <algorithm>

#include "common/kernel.h"
#ifdef __CUDACC__
#include "common/cuda.cuh"
#endif

namespace blitzgs {

// The grid of cells of a cloud of points: its low corner and the resolution.
struct MortonFrame {
  double low[3];
  double cells_per_unit;  // 2^21 cells along the longest axis
};

// Moves bit i of the lowest 21 bits to bit 3 i.
BLITZGS_HD uint64_t spread_bits(uint64_t x) {
  x &= 0x1fffff;
  x = (x | x << 32) & 0x1f00000000ffffULL;
  x = (x | x << 16) & 0x1f0000ff0000ffULL;
  x = (x | x << 8) & 0x100f00f00f00f00fULL;
  x = (x | x << 4) & 0x10c30c30c30c30c3ULL;
  x = (x | x << 2) & 0x1249249249249249ULL;
  return x;
}

template <class T> BLITZGS_HD bool is_finite_point(const T* p) {
  const T sum = p[0] * T(0) + p[1] * T(0) + p[2] * T(0);
  return sum == T(0);
}

// The code of a point. A point that is not finite gets all ones, so that it sorts last.
template <class T> BLITZGS_HD uint64_t morton_code(const T* p, const MortonFrame& frame) {
  if (!is_finite_point(p)) return ~uint64_t{0};
  uint64_t code = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double cell = (double(p[axis]) - frame.low[axis]) * frame.cells_per_unit;
    const double clamped = cell > 0 ? (cell < 2097151.0 ? cell : 2097151.0) : 0.0;
    code |= spread_bits(uint64_t(clamped)) << axis;
  }
  return code;
}

BLITZGS_HD MortonFrame make_morton_frame(const double* low, const double* high) {
  MortonFrame frame{{low[0], low[1], low[2]}, 0.0};
  double extent = 0;
  for (int axis = 0; axis < 3; ++axis) {
    extent = high[axis] - low[axis] > extent ? high[axis] - low[axis] : extent;
  }
  frame.cells_per_unit = extent > 0 ? 2097152.0 / extent : 0.0;
  return frame;
}

// The frame of all finite points, on the host.
template <class T> MortonFrame morton_frame_of(const T* points, int64_t n) {
  double low[3] = {0, 0, 0}, high[3] = {0, 0, 0};
  bool first = true;
  for (int64_t i = 0; i < n; ++i) {
    const T* p = points + 3 * i;
    if (!is_finite_point(p)) continue;
    for (int axis = 0; axis < 3; ++axis) {
      const double x = p[axis];
      low[axis] = first ? x : std::min(low[axis], x);
      high[axis] = first ? x : std::max(high[axis], x);
    }
    first = false;
  }
  return make_morton_frame(low, high);
}

}  // namespace blitzgs

#ifdef __CUDACC__
// The Morton frame of a cloud of points, computed on the GPU: the host need not wait.
namespace blitzgs::cuda {

// Maps floats to integers of the same order, so that atomicMin and atomicMax find the bounds of the cloud.
__device__ inline int32_t ordered(float x) {
  const int32_t bits = __float_as_int(x);
  return bits < 0 ? bits ^ 0x7fffffff : bits;
}
__device__ inline float unordered(int32_t bits) {
  return __int_as_float(bits < 0 ? bits ^ 0x7fffffff : bits);
}

struct MortonBounds {
  int32_t low[3], high[3];
  int32_t finite;  // number of finite points
};

// Sets the bounds to those of no points. One warp.
static __global__ void reset_bounds(MortonBounds* bounds) {
  const int axis = threadIdx.x;
  if (axis < 3) bounds->low[axis] = INT32_MAX, bounds->high[axis] = INT32_MIN;
  if (axis == 3) bounds->finite = 0;
}

// Finds the bounding box and the number of the finite points of points [n, 3]. A thread per point, in a loop.
static __global__ void find_bounds(const float* points, int64_t n, MortonBounds* bounds) {
  int32_t low[3] = {INT32_MAX, INT32_MAX, INT32_MAX}, high[3] = {INT32_MIN, INT32_MIN, INT32_MIN}, finite = 0;
  for (int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x; i < n;
       i += int64_t{gridDim.x} * blockDim.x) {
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
    const int32_t l = __reduce_min_sync(kFullWarp, low[axis]), h = __reduce_max_sync(kFullWarp, high[axis]);
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

inline MortonBounds* find_morton_bounds(const float* points, int64_t n, Workspace& workspace,
                                        cudaStream_t stream) {
  MortonBounds* bounds = workspace.allocate<MortonBounds>(1);
  reset_bounds<<<1, 32, 0, stream>>>(bounds);
  find_bounds<<<std::min(blocks_for(n, 256), 1024u), 256, 0, stream>>>(points, n, bounds);
  check_launch("morton bounds");
  return bounds;
}

}  // namespace blitzgs::cuda
#endif
