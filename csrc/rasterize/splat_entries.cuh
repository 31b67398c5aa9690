// SPDX-License-Identifier: Apache-2.0
// Gradients that repeat bit for bit: the entries of each splat, found by a stable sort, are added in their
// order.
#pragma once
#include <cub/device/device_radix_sort.cuh>

#include <stdexcept>
#include <string>

#include "common/cuda_check.h"
#include "rasterize/tile_batch.cuh"

namespace blitzgs::cuda {

inline __global__ void iota_kernel(std::int32_t* values, std::int64_t n) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i < n) values[i] = static_cast<std::int32_t>(i);
}

// Adds each splat's entries in the order of the list of all tiles. Of the n entries those from *n_listed on
// are of no tile, and name any splat: sorted by the low bits of it, they come behind the listed ones of a
// splat.
inline __global__ void sum_entries_kernel(const std::int32_t* sorted_splats, const std::int32_t* entries,
                                          std::int64_t n, const std::int64_t* n_listed,
                                          const PackedGradient* entry_gradients,
                                          PackedGradient* splat_gradients) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (i >= 3 * n) return;
  const int quad = static_cast<int>(i % 3);
  std::int64_t at = i / 3;
  const std::int64_t end = *n_listed;
  const std::int32_t splat = sorted_splats[at];
  if (entries[at] >= end || (at > 0 && sorted_splats[at - 1] == splat)) return;
  float4 sum{0.f, 0.f, 0.f, 0.f};
  for (; at < n && sorted_splats[at] == splat && entries[at] < end; ++at) {
    const float4 part = entry_gradients[entries[at]].quads[quad];
    sum = {sum.x + part.x, sum.y + part.y, sum.z + part.z, sum.w + part.w};
  }
  splat_gradients[splat].quads[quad] = sum;
}

// Which entries belong to each splat, in order.
struct EntriesBySplat {
  std::int32_t* splats;
  std::int32_t* entries;
};

inline EntriesBySplat sort_entries(const std::int32_t* isect_splats, std::int64_t n, std::int64_t n_splats,
                                   Workspace& workspace, CudaStream stream) {
  if (n > INT32_MAX) {
    throw std::runtime_error(
        "blitzgs::rasterize_bwd: deterministic gradients hold at most 2^31 - 1 intersections, got " +
        std::to_string(n) + "; render fewer views at once or set deterministic=False");
  }
  int bits = 1;
  while (bits < 31 && (std::int64_t{1} << bits) < n_splats) ++bits;
  EntriesBySplat sorted{workspace.allocate<std::int32_t>(n), workspace.allocate<std::int32_t>(n)};
  auto* order = workspace.allocate<std::int32_t>(n);
  iota_kernel<<<blocks_for(n, 256), 256, 0, stream>>>(order, n);
  check_launch("rasterize_bwd");
  std::size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, isect_splats, sorted.splats, order, sorted.entries, n,
                                        0, bits, stream),
        "rasterize_bwd");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceRadixSort::SortPairs(scratch, bytes, isect_splats, sorted.splats, order, sorted.entries, n,
                                        0, bits, stream),
        "rasterize_bwd");
  return sorted;
}

}  // namespace blitzgs::cuda
