// SPDX-License-Identifier: Apache-2.0
// Rows are sorted by depth once (32-bit keys, P of them); their entries are written in that order with the
// tile as a key, 16 bits where the tiles of the launch fit, and a stable radix sort over just the bits in use
// brings each tile's entries together without disturbing their order. Which tiles a row touches is found
// once, in row order, and kept in 16 bytes: those of all rows fit into the L2 cache, where depth order
// gathers them. Compiled without FMA contraction (cmake/cuda.cmake), as the projection is: both count the
// same tiles.
#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_reduce.cuh>

#include <cuda/std/functional>

#include "common/arrays.h"
#include "intersect/running_sum.cuh"
#include "intersect/touched_tiles.cuh"

namespace blitzgs::cuda {

namespace {

using Input = IntersectInput<float>;
constexpr int kThreads = 256;
constexpr int kEmitItems = 2, kEmitRows = kThreads * kEmitItems;  // rows of a thread and of a block

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

// Writes the entries of a warp's rows, a row a lane, from `turn` on; start: of the lane's row behind `turn`.
template <class Key>
__device__ __forceinline__ void write_entries(const Input& in, std::int32_t row, const Touched& touched,
                                              std::int32_t start, std::int64_t turn, std::int64_t capacity,
                                              Key* keys, std::int32_t* entries) {
  const int lane = threadIdx.x % 32;
  // Of compact rows each lane writes every 32nd entry, whosever it is.
  const std::int32_t count = touched.compact() ? touched.count() : 0;
  const std::int32_t until = sum_of_lanes_until(count, lane), total = __shfl_sync(kFullWarp, until, 31);
  const std::int32_t begin = until - count;
  for (std::int32_t first = 0; first < total; first += 32) {
    const std::int32_t entry = first + lane;
    int source = 0;  // the last row that begins there or before
#pragma unroll
    for (int step = 16; step > 0; step /= 2) {
      if (__shfl_sync(kFullWarp, begin, source + step) <= entry) source += step;
    }
    const std::int32_t k = entry - __shfl_sync(kFullWarp, begin, source);
    const std::int64_t at = turn + __shfl_sync(kFullWarp, start, source) + k;
    const std::int32_t of_row = __shfl_sync(kFullWarp, row, source);
    const Touched its = touched.of_lane(source);
    if (entry < total && at < capacity) {
      keys[at] = static_cast<Key>(its.tile(k, in.grid.tiles_x));
      entries[at] = of_row;
    }
  }
  // The other rows are walked by all lanes together.
  for (unsigned left = __ballot_sync(kFullWarp, !touched.compact()); left; left &= left - 1) {
    const int source = __ffs(left) - 1;
    const std::int32_t of_row = __shfl_sync(kFullWarp, row, source);
    std::int64_t at = turn + __shfl_sync(kFullWarp, start, source);
    for_each_owned(in, of_row, [&](const Owned& owned) {
      const std::int64_t n = owned.last - owned.first, tile = owned.first - in.grid.tile_begin;
      for (std::int64_t k = lane; k < n && at + k < capacity; k += 32) {
        keys[at + k] = static_cast<Key>(tile + k);
        entries[at + k] = of_row;
      }
      at += n;
    });
  }
}

// Entries in depth order. Blocks take kEmitRows rows each, a warp 32 times kEmitItems of them in a row.
template <class Key>
__global__ void __launch_bounds__(kThreads)
    emit_kernel(const Input in, const Touched* all_touched, const std::int32_t* rows, RunningSum running,
                std::int64_t capacity, Key* keys, std::int32_t* entries) {
  __shared__ std::int64_t warp_sums[kThreads / 32], entries_before;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int block = running.take_turn();
  const std::int64_t first = static_cast<std::int64_t>(block) * kEmitRows + warp * (32 * kEmitItems) + lane;
  std::int32_t row[kEmitItems];
  Touched touched[kEmitItems];
#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) row[k] = first + 32 * k < in.n_rows ? rows[first + 32 * k] : -1;
#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) touched[k] = row[k] >= 0 ? all_touched[row[k]] : Touched{};

  std::int32_t start[kEmitItems];  // of each row, in its warp's turn
  std::int64_t turn[kEmitItems], warp_sum = 0;
#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) {
    const std::int32_t count = touched[k].count(), until = sum_of_lanes_until(count, lane);
    start[k] = until - count;
    turn[k] = warp_sum;
    warp_sum += __shfl_sync(kFullWarp, until, 31);
  }
  if (lane == 0) warp_sums[warp] = warp_sum;
  __syncthreads();
  std::int64_t before = 0, sum = 0;
  for (int i = 0; i < kThreads / 32; ++i) {
    if (i == warp) before = sum;
    sum += warp_sums[i];
  }
  if (warp == 0) {
    const std::int64_t earlier = running.sum_before(block, sum);
    if (lane == 0) entries_before = earlier;
  }
  __syncthreads();
  before += entries_before;

#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) {
    write_entries(in, row[k], touched[k], start[k], before + turn[k], capacity, keys, entries);
  }
}

// Slots beyond the true count sort behind every tile.
template <class Key>
__global__ void fill_tail_kernel(RunningSum running, unsigned n_blocks, std::int64_t capacity, Key sentinel,
                                 Key* keys, std::int32_t* entries) {
  const std::int64_t step = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i =
           running.total(n_blocks) + blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
       i < capacity; i += step) {
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
  Touched* touched;    // [P] of each row
  std::int32_t* rows;  // [P] by (depth, id)
};

DepthOrder order_by_depth(const Input& in, Workspace& workspace, CudaStream stream) {
  const std::int64_t n = in.n_rows;
  auto [touched, keys, sorted_keys, unsorted, rows] =
      allocate_arrays<Touched, std::uint32_t, std::uint32_t, std::int32_t, std::int32_t>(n, workspace);
  depth_keys_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, keys, unsorted, touched);
  check_launch("intersect");
  sort_pairs(keys, sorted_keys, unsorted, rows, n, 32, workspace, stream);
  if (in.ids) {
    order_ties_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(sorted_keys, rows, in.ids, n);
    check_launch("intersect");
  }
  return {touched, rows};
}

template <class Key>
void list_entries(const Input& in, const DepthOrder& order, std::int64_t capacity, std::int32_t* isect_rows,
                  std::int64_t* tile_offsets, Workspace& workspace, CudaStream stream) {
  const std::int64_t n_tiles = in.grid.tile_end - in.grid.tile_begin;
  auto [keys, sorted_keys, entries] = allocate_arrays<Key, Key, std::int32_t>(capacity, workspace);
  const unsigned blocks = blocks_for(in.n_rows, kEmitRows);
  const RunningSum running(blocks, workspace, stream);
  emit_kernel<<<blocks, kThreads, 0, stream>>>(in, order.touched, order.rows, running, capacity, keys,
                                               entries);
  check_launch("intersect");
  fill_tail_kernel<<<64, kThreads, 0, stream>>>(running, blocks, capacity, static_cast<Key>(n_tiles), keys,
                                                entries);
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
