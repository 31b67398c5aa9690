// SPDX-License-Identifier: Apache-2.0
// Rows are sorted by depth once (32-bit keys, P of them); their entries are written in that order with the
// tile as a key, 16 bits where the tiles of the launch fit, and a stable radix sort over just the bits in use
// brings each tile's entries together without disturbing their order. Which tiles a row touches is found
// once, in row order, and kept in 16 bytes: those of all rows fit into the L2 cache, where depth order
// gathers them. Compiled without FMA contraction (cmake/cuda.cmake), as the projection is: both count the
// same tiles.
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_reduce.cuh>
#include <cub/device/device_scan.cuh>

#include <cuda/std/functional>

#include "common/cuda_check.h"
#include "intersect/intersect.h"

namespace blitzgs::cuda {

namespace {

using Input = IntersectInput<float>;
constexpr int kThreads = 256;
constexpr int kWideRow = 24;  // entries from which a warp writes a row's list together

struct Owned {
  std::int64_t first, last;  // tiles [first, last)
  int ty;                    // the tile row in its image
};

// Calls f(owned tiles) for each tile row the splat touches.
template <class F>
__device__ __forceinline__ void for_each_owned(const Input& in, std::int64_t row, const F& f) {
  const TileGrid& grid = in.grid;
  const std::int64_t image = in.camera_ids[row] * grid.per_image();
  const float2 mean2d = reinterpret_cast<const float2*>(in.means2d)[row];
  const float conic[3] = {in.conics[3 * row], in.conics[3 * row + 1], in.conics[3 * row + 2]};
  const float center[2] = {mean2d.x, mean2d.y};
  for_each_tile_row(center, conic, in.opacities[row], grid.width, grid.height, grid.tile_size,
                    [&](int ty, int begin, int end) {
                      const std::int64_t base = image + static_cast<std::int64_t>(ty) * grid.tiles_x;
                      Owned owned{base + begin, base + end, ty};
                      if (owned.first < grid.tile_begin) owned.first = grid.tile_begin;
                      if (owned.last > grid.tile_end) owned.last = grid.tile_end;
                      if (owned.first < owned.last) f(owned);
                    });
}

// The owned tiles that a row touches. Compact: tile `first` (from tile_begin on) and up to twelve tile rows,
// a byte each: in the low half the number of tiles, in the high half 8 + their shift against the first row's.
// Other shapes have first = kWalk, and the number of tiles in rows[0].
struct alignas(16) Touched {
  static constexpr std::uint32_t kWalk = ~0u;
  static constexpr int kWords = 3;
  std::uint32_t first, rows[kWords];

  __host__ __device__ std::int32_t count() const {
    if (first == kWalk) return static_cast<std::int32_t>(rows[0]);
    constexpr std::uint32_t kCounts = 0x0f0f0f0fu;
    const std::uint32_t sums = (rows[0] & kCounts) + (rows[1] & kCounts) + (rows[2] & kCounts);
    return static_cast<std::int32_t>(sums * 0x01010101u >> 24);
  }
};

__device__ __forceinline__ Touched find_touched(const Input& in, std::int64_t row) {
  std::int64_t count = 0, first = in.grid.tile_begin;
  int top = 0;
  bool compact = true;
  Touched touched{};
  for_each_owned(in, row, [&](const Owned& owned) {
    if (count == 0) {
      first = owned.first;
      top = owned.ty;
    }
    const std::int64_t n = owned.last - owned.first;
    const int down = owned.ty - top;
    const std::int64_t shift = owned.first - first - static_cast<std::int64_t>(down) * in.grid.tiles_x + 8;
    compact &= down < 4 * Touched::kWords && n < 16 && shift >= 0 && shift < 16;
    const std::uint32_t bits = static_cast<std::uint32_t>(shift << 4 | n) << 8 * (down & 3);
#pragma unroll
    for (int i = 0; i < Touched::kWords; ++i) touched.rows[i] |= down >> 2 == i ? bits : 0u;
    count += n;
  });
  first -= in.grid.tile_begin;
  touched.first = static_cast<std::uint32_t>(first);
  if (!compact || first >= Touched::kWalk) {
    touched.first = Touched::kWalk;
    touched.rows[0] = static_cast<std::uint32_t>(count);
  }
  return touched;
}

// Calls f(first tile, from tile_begin on; number of tiles) for each tile row of find_touched().
template <class F>
__device__ __forceinline__ void for_each_touched(const Input& in, std::int64_t row, const Touched& touched,
                                                 const F& f) {
  if (touched.first == Touched::kWalk) {
    for_each_owned(in, row, [&](const Owned& owned) {
      f(owned.first - in.grid.tile_begin, static_cast<int>(owned.last - owned.first));
    });
    return;
  }
  std::int64_t start = static_cast<std::int64_t>(touched.first) - 8;
#pragma unroll
  for (int i = 0; i < Touched::kWords; ++i, start += 4 * in.grid.tiles_x) {
    std::int64_t tile = start;
    for (std::uint32_t rows = touched.rows[i]; rows; rows >>= 8, tile += in.grid.tiles_x) {
      f(tile + (rows >> 4 & 15u), static_cast<int>(rows & 15u));
    }
  }
}

__global__ void count_kernel(const Input in, std::int32_t* counts) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (i < in.n_rows) counts[i] = find_touched(in, i).count();
}

// Depths as unsigned integers in the same order, the rows' indices and what they touch.
__global__ void depth_keys_kernel(const Input in, std::uint32_t* keys, std::int32_t* rows, Touched* touched) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (i >= in.n_rows) return;
  const std::uint32_t bits = __float_as_uint(in.depths[i]);
  keys[i] = bits ^ (bits >> 31 ? 0xffffffffu : 0x80000000u);
  rows[i] = static_cast<std::int32_t>(i);
  touched[i] = find_touched(in, i);
}

__device__ void sift_down(std::int32_t* rows, const std::int64_t* ids, std::int64_t root, std::int64_t n) {
  for (std::int64_t child; (child = 2 * root + 1) < n; root = child) {
    if (child + 1 < n && ids[rows[child]] < ids[rows[child + 1]]) ++child;
    if (ids[rows[root]] >= ids[rows[child]]) return;
    const std::int32_t row = rows[root];
    rows[root] = rows[child];
    rows[child] = row;
  }
}

// Orders each run of equal depths by id: insertion for the usual handful, heapsort for the freak.
__global__ void order_ties_kernel(const std::uint32_t* keys, std::int32_t* rows, const std::int64_t* ids,
                                  std::int64_t n) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (i + 1 >= n || keys[i] != keys[i + 1] || (i > 0 && keys[i - 1] == keys[i])) return;
  std::int64_t end = i + 2;
  while (end < n && keys[end] == keys[i]) ++end;
  std::int32_t* run = rows + i;
  const std::int64_t length = end - i;
  bool ordered = true;
  for (std::int64_t k = 1; k < length && ordered; ++k) ordered = ids[run[k - 1]] < ids[run[k]];
  if (ordered) return;
  if (length <= 32) {
    for (std::int64_t k = 1; k < length; ++k) {
      const std::int32_t row = run[k];
      std::int64_t at = k;
      for (; at > 0 && ids[run[at - 1]] > ids[row]; --at) run[at] = run[at - 1];
      run[at] = row;
    }
    return;
  }
  for (std::int64_t root = length / 2; root-- > 0;) sift_down(run, ids, root, length);
  for (std::int64_t left = length - 1; left > 0; --left) {
    const std::int32_t row = run[0];
    run[0] = run[left];
    run[left] = row;
    sift_down(run, ids, 0, left);
  }
}

struct GatherCount {
  const Touched* touched;
  const std::int32_t* rows;
  std::int64_t n;
  __host__ __device__ std::int64_t operator()(std::int64_t i) const {
    return i < n ? touched[rows[i]].count() : 0;
  }
};

// Entries in depth order. offsets [P + 1].
template <class Key>
__global__ void emit_kernel(const Input in, const Touched* all_touched, const std::int32_t* rows,
                            const std::int64_t* offsets, std::int64_t capacity, Key* keys,
                            std::int32_t* entries) {
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  const bool present = i < in.n_rows;
  const std::int32_t row = present ? rows[i] : 0;
  const std::int64_t offset = present ? offsets[i] : 0;
  const Touched touched = all_touched[row];
  const bool wide = present && touched.count() >= kWideRow;
  if (present && !wide) {
    std::int64_t at = offset;
    for_each_touched(in, row, touched, [&](std::int64_t first, int n) {
      for (int k = 0; k < n && at < capacity; ++k, ++at) {
        keys[at] = static_cast<Key>(first + k);
        entries[at] = row;
      }
    });
  }
  // Every lane walks a wide row's tile rows, and writes its share of each.
  const int lane = threadIdx.x % 32;
  for (unsigned left = __ballot_sync(0xffffffffu, wide); left; left &= left - 1) {
    const int source = __ffs(left) - 1;
    const std::int32_t wide_row = __shfl_sync(0xffffffffu, row, source);
    Touched wide_touched{__shfl_sync(0xffffffffu, touched.first, source), {}};
    for (int k = 0; k < Touched::kWords; ++k) {
      wide_touched.rows[k] = __shfl_sync(0xffffffffu, touched.rows[k], source);
    }
    std::int64_t at = __shfl_sync(0xffffffffu, offset, source);
    for_each_touched(in, wide_row, wide_touched, [&](std::int64_t first, int n) {
      for (int k = lane; k < n && at + k < capacity; k += 32) {
        keys[at + k] = static_cast<Key>(first + k);
        entries[at + k] = wide_row;
      }
      at += n;
    });
  }
}

// Slots beyond the true count sort behind every tile.
template <class Key>
__global__ void fill_tail_kernel(const std::int64_t* total, std::int64_t capacity, Key sentinel, Key* keys,
                                 std::int32_t* entries) {
  const std::int64_t step = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i = *total + blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x; i < capacity;
       i += step) {
    keys[i] = sentinel;
    entries[i] = 0;
  }
}

// tile_offsets[t] = first entry whose tile is >= t.
template <class Key>
__global__ void tile_offsets_kernel(const Key* keys, std::int64_t n, TileGrid grid,
                                    std::int64_t* tile_offsets) {
  const std::int64_t tile = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (tile > grid.count()) return;
  std::int64_t wanted = tile < grid.tile_end ? tile : grid.tile_end;
  wanted -= grid.tile_begin;
  std::int64_t low = 0, high = wanted <= 0 ? 0 : n;
  while (low < high) {
    const std::int64_t middle = (low + high) / 2;
    if (static_cast<std::int64_t>(keys[middle]) < wanted) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  tile_offsets[tile] = low;
}

template <class Key, class Value>
void sort_pairs(const Key* keys, Key* sorted_keys, const Value* values, Value* sorted_values, std::int64_t n,
                int bits, Workspace& workspace, CudaStream stream) {
  std::size_t bytes = 0;
  check(cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, sorted_keys, values, sorted_values, n, 0, bits,
                                        stream),
        "intersect");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceRadixSort::SortPairs(scratch, bytes, keys, sorted_keys, values, sorted_values, n, 0, bits,
                                        stream),
        "intersect");
}

struct DepthOrder {
  Touched* touched;       // [P] of each row
  std::int32_t* rows;     // [P] by (depth, id)
  std::int64_t* offsets;  // [P + 1] first entry of each
};

DepthOrder order_by_depth(const Input& in, Workspace& workspace, CudaStream stream) {
  const std::int64_t n = in.n_rows;
  auto* keys = workspace.allocate<std::uint32_t>(n);
  auto* sorted_keys = workspace.allocate<std::uint32_t>(n);
  auto* unsorted = workspace.allocate<std::int32_t>(n);
  DepthOrder order{workspace.allocate<Touched>(n), workspace.allocate<std::int32_t>(n),
                   workspace.allocate<std::int64_t>(n + 1)};
  depth_keys_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, keys, unsorted, order.touched);
  check_launch("intersect");
  sort_pairs(keys, sorted_keys, unsorted, order.rows, n, 32, workspace, stream);
  if (in.ids) {
    order_ties_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(sorted_keys, order.rows, in.ids, n);
    check_launch("intersect");
  }
  const auto counted = thrust::make_transform_iterator(thrust::make_counting_iterator(std::int64_t{0}),
                                                       GatherCount{order.touched, order.rows, n});
  std::size_t bytes = 0;
  check(cub::DeviceScan::ExclusiveSum(nullptr, bytes, counted, order.offsets, n + 1, stream), "intersect");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceScan::ExclusiveSum(scratch, bytes, counted, order.offsets, n + 1, stream), "intersect");
  return order;
}

template <class Key>
void list_entries(const Input& in, const DepthOrder& order, std::int64_t capacity, std::int32_t* isect_rows,
                  std::int64_t* tile_offsets, Workspace& workspace, CudaStream stream) {
  const std::int64_t n_tiles = in.grid.tile_end - in.grid.tile_begin;
  auto* keys = workspace.allocate<Key>(capacity);
  auto* sorted_keys = workspace.allocate<Key>(capacity);
  auto* entries = workspace.allocate<std::int32_t>(capacity);
  emit_kernel<<<blocks_for(in.n_rows, kThreads), kThreads, 0, stream>>>(
      in, order.touched, order.rows, order.offsets, capacity, keys, entries);
  check_launch("intersect");
  fill_tail_kernel<<<64, kThreads, 0, stream>>>(order.offsets + in.n_rows, capacity,
                                                static_cast<Key>(n_tiles), keys, entries);
  check_launch("intersect");
  int bits = 1;
  while ((std::int64_t{1} << bits) <= n_tiles) ++bits;
  sort_pairs(keys, sorted_keys, entries, isect_rows, capacity, bits, workspace, stream);
  tile_offsets_kernel<<<blocks_for(in.grid.count() + 1, kThreads), kThreads, 0, stream>>>(
      sorted_keys, capacity, in.grid, tile_offsets);
  check_launch("intersect");
}

}  // namespace

template <>
std::int64_t count_intersections<float>(const Input& in, Workspace& workspace, CudaStream stream) {
  if (in.n_rows == 0 || in.grid.tile_end <= in.grid.tile_begin) return 0;
  auto* counts = workspace.allocate<std::int32_t>(in.n_rows);
  auto* total = workspace.allocate<std::int64_t>(1);
  count_kernel<<<blocks_for(in.n_rows, kThreads), kThreads, 0, stream>>>(in, counts);
  check_launch("intersect");
  std::size_t bytes = 0;
  const auto sum = [&](void* scratch) {
    return cub::DeviceReduce::Reduce(scratch, bytes, counts, total, in.n_rows,
                                     ::cuda::std::plus<std::int64_t>{}, std::int64_t{0}, stream);
  };
  check(sum(nullptr), "intersect");
  check(sum(workspace.allocate_bytes(bytes)), "intersect");
  std::int64_t host = 0;
  check(cudaMemcpyAsync(&host, total, sizeof(host), cudaMemcpyDeviceToHost, stream), "intersect");
  check(cudaStreamSynchronize(stream), "intersect");
  return host;
}

template <>
std::int64_t intersect<float>(const Input& in, std::int64_t capacity, std::int32_t* isect_rows,
                              std::int64_t* tile_offsets, Workspace& workspace, CudaStream stream) {
  const std::int64_t n_tiles = in.grid.tile_end - in.grid.tile_begin;
  if (in.n_rows == 0 || capacity == 0 || n_tiles <= 0) {
    check(cudaMemsetAsync(tile_offsets, 0, (in.grid.count() + 1) * sizeof(std::int64_t), stream),
          "intersect");
    return capacity;
  }
  const DepthOrder order = order_by_depth(in, workspace, stream);
  if (n_tiles < 65536) {
    list_entries<std::uint16_t>(in, order, capacity, isect_rows, tile_offsets, workspace, stream);
  } else {
    list_entries<std::uint32_t>(in, order, capacity, isect_rows, tile_offsets, workspace, stream);
  }
  return capacity;
}

}  // namespace blitzgs::cuda
