// SPDX-License-Identifier: Apache-2.0
#include "active/morton_keys.h"
#include "common/cuda.cuh"
#include "math/morton_cuda.cuh"

namespace blitzgs::cuda {

namespace {

// keys [n] of points [n, 3], one thread per point.
__global__ void make_keys(const float* points, std::int64_t n, const MortonBounds* bounds,
                          std::int64_t* keys) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < n) keys[i] = static_cast<std::int64_t>(morton_code(points + 3 * i, frame_of(*bounds)) >> 1);
}

}  // namespace

void morton_keys(const float* points, std::int64_t n, std::int64_t* keys, Workspace& workspace,
                 CudaStream stream) {
  if (n == 0) return;
  const MortonBounds* bounds = find_morton_bounds(points, n, workspace, stream);
  make_keys<<<blocks_for(n, 256), 256, 0, stream>>>(points, n, bounds, keys);
  check_launch("morton_keys");
}

}  // namespace blitzgs::cuda
