// SPDX-License-Identifier: Apache-2.0
// The tiles' lists (intersect.h) on CUDA:
// 1. range_kernel, depth_keys_kernel, three passes of sweep_kernel and order_ties_kernel sort the splats by
//    (depth, id) and find the tiles of each splat, which they keep in 16 bytes, so that the data of all
//    splats fit into the L2 cache when step 2 gathers them in depth order (depth_order.cuh, radix_sweep.cuh).
// 2. emit_kernel writes the list entries in this order, with the tile as key (16 bits if there are few
//    enough). It leaves large splats to emit_large_kernel, which has a warp for each: neighbours in depth are
//    often large together, as everything close to a camera is.
// 3. Passes of sweep_kernel, a stable radix sort, order the entries by tile and keep their order otherwise.
// 4. tile_offsets_kernel finds where each tile's list begins.
//
// (The renderer of 3DGS sorts the entries once, by tile and depth; Kerbl et al. 2023, section 6.) This file
// is compiled without FMA contraction (cmake/cuda.cmake), like the projection.
#include <cub/device/device_reduce.cuh>

#include <cuda/std/functional>

#include "intersect/depth_order.cuh"
#include "intersect/radix_sweep.cuh"

namespace blitzgs::cuda {
namespace {

using Input = IntersectInput<float>;
constexpr int kThreads = 256;
constexpr int kEmitItems = 4, kEmitSplats = kThreads * kEmitItems;  // splats per thread and per block
constexpr int kLargeBlocks = 4;  // blocks of emit_large_kernel per multiprocessor

// The digits by which entries are sorted by tile: as few passes as the number of tiles allows, and the fewest
// bits per digit for this number of passes.
struct TileDigits {
  static constexpr int kBits = 8, kBins = 1 << kBits, kMax = 4;
  int passes = 1, width = 1;

  explicit TileDigits(int64_t n_tiles) {
    int bits = 1;
    while ((int64_t{1} << bits) < n_tiles) ++bits;
    passes = (bits + kBits - 1) / kBits;
    width = (bits + passes - 1) / passes;
  }
  __device__ void count(uint32_t tile, uint32_t* counts) const {
    for (int pass = 0; pass < passes; ++pass) {
      atomicAdd(&counts[pass * kBins + (tile >> pass * width & ((1u << width) - 1))], 1u);
    }
  }
};

// counts [P] = the number of owned tiles that each splat touches, one thread per splat.
__global__ void count_kernel(const Input in, int32_t* counts) {
  const int64_t i = blockIdx.x * int64_t(kThreads) + threadIdx.x;
  if (i >= in.n_splats) return;
  counts[i] = i < valid_splat_count(in) ? find_touched(in.grid, load_splat(in, i)).count() : 0;
}

struct LaneEntry {
  int source;      // the lane that the entry belongs to
  int32_t k;       // its number among that lane's entries
  int32_t number;  // its number among all entries of the warp
  bool valid;      // false if no entry is left for this lane
};

// Numbers the entries of a warp's lanes, `count` of each lane, one lane after the other, and shares them out
// evenly: calls f(LaneEntry) for 32 entries at a time, on all lanes. Returns the number of entries.
template <class F> __device__ __forceinline__ int32_t share_entries(int32_t count, int lane, const F& f) {
  const int32_t until = sum_of_lanes_until(count, lane), total = __shfl_sync(kFullWarp, until, 31);
  const int32_t begin = until - count;
  for (int32_t first = 0; first < total; first += 32) {
    const int32_t number = first + lane;
    int source = 0;  // the last lane whose entries begin at `number` or before
#pragma unroll
    for (int step = 16; step > 0; step /= 2) {
      if (__shfl_sync(kFullWarp, begin, source + step) <= number) source += step;
    }
    f(LaneEntry{source, number - __shfl_sync(kFullWarp, begin, source), number, number < total});
  }
  return total;
}

// The list entries in the order of the splats: the tile (keys) and the splat of each, [capacity].
template <class Key> struct Entries {
  int64_t capacity;
  Key* keys;
  int32_t* splats;
  TileDigits digits;
  uint64_t* histograms;  // of the tiles' digits

  __device__ void write(int64_t at, uint32_t tile, int32_t splat, uint32_t* counts) const {
    if (at >= capacity) return;
    keys[at] = Key(tile);
    splats[at] = splat;
    digits.count(tile, counts);
  }
};

// Writes the entries of a warp's splats, one splat for each lane. The warp's entries begin at `turn`, the
// lane's at `turn` + `start`.
template <class Key>
__device__ __forceinline__ void write_entries(const Input& in, int32_t splat, const Touched& touched,
                                              int32_t start, int64_t turn, const Entries<Key>& entries,
                                              uint32_t* counts) {
  const int lane = threadIdx.x % 32;
  share_entries(touched.large() ? 0 : touched.count(), lane, [&](const LaneEntry& entry) {
    const int64_t at = turn + __shfl_sync(kFullWarp, start, entry.source) + entry.k;
    const int32_t entry_splat = __shfl_sync(kFullWarp, splat, entry.source);
    const Touched entry_touched = touched.from_lane(entry.source);
    if (entry.valid) entries.write(at, entry_touched.tile(entry.k, in.grid.tiles_x), entry_splat, counts);
  });
}

// Writes the list entries in depth order, except for those of large splats, and the number of all entries.
// Lists the large splats (large_splats, n_large) and sets the positions of their first entries in
// all_touched. A block handles kEmitSplats consecutive sorted splats, a warp 32 * kEmitItems of them.
template <class Key>
__global__ void __launch_bounds__(kThreads, 4)
    emit_kernel(const Input in, Touched* all_touched, const int32_t* splats, const int64_t* n_splats,
                RunningSum running, const Entries<Key> entries, int64_t* n_entries, int32_t* large_splats,
                int32_t* n_large) {
  __shared__ int64_t warp_sums[kThreads / 32];
  __shared__ uint32_t counts[TileDigits::kMax * TileDigits::kBins];
  const int bins = entries.digits.passes * TileDigits::kBins;
  for (int bin = threadIdx.x; bin < bins; bin += kThreads) counts[bin] = 0;
  wait_for_earlier_kernels();
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int64_t n = *n_splats;
  const int block = running.take_turn();
  const int64_t begin = int64_t(block) * kEmitSplats, end = begin + kEmitSplats;
  if (begin >= n) return;
  const int64_t first = begin + warp * (32 * kEmitItems) + lane;
  int32_t splat[kEmitItems];
  Touched touched[kEmitItems];
#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) splat[k] = first + 32 * k < n ? splats[first + 32 * k] : -1;
#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) touched[k] = splat[k] >= 0 ? all_touched[splat[k]] : Touched{};

  int32_t start[kEmitItems];  // where each splat's entries begin, counted from its warp's first entry
  int64_t turn[kEmitItems], warp_sum = 0;
#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) {
    const int32_t count = touched[k].count(), until = sum_of_lanes_until(count, lane);
    start[k] = until - count;
    turn[k] = warp_sum;
    warp_sum += __shfl_sync(kFullWarp, until, 31);
  }
  if (lane == 0) warp_sums[warp] = warp_sum;
  __syncthreads();
  int64_t before = 0, sum = 0;
  for (int i = 0; i < kThreads / 32; ++i) {
    if (i == warp) before = sum;
    sum += warp_sums[i];
  }
  const int64_t earlier = running.sum_before<kThreads>(block, sum);
  if (threadIdx.x == 0 && end >= n) *n_entries = min(earlier + sum, entries.capacity);
  before += earlier;

#pragma unroll
  for (int k = 0; k < kEmitItems; ++k) {
    if (touched[k].large()) {
      all_touched[splat[k]].set_begin(before + turn[k] + start[k]);
      large_splats[atomicAdd(n_large, 1)] = splat[k];
    }
    write_entries(in, splat[k], touched[k], start[k], before + turn[k], entries, counts);
  }
  __syncthreads();
  add_counts(counts, bins, entries.histograms);
}

// Writes the entries of large splats, one warp for each splat in a grid-stride loop. Each lane finds the
// tiles of every 32nd tile row.
template <class Key>
__global__ void __launch_bounds__(kThreads)
    emit_large_kernel(const Input in, const Touched* all_touched, const int32_t* large_splats,
                      const int32_t* n_large, const Entries<Key> entries) {
  __shared__ uint32_t counts[TileDigits::kMax * TileDigits::kBins];
  const int bins = entries.digits.passes * TileDigits::kBins;
  for (int bin = threadIdx.x; bin < bins; bin += kThreads) counts[bin] = 0;
  wait_for_earlier_kernels();
  constexpr int kWarps = kThreads / 32;
  const int lane = threadIdx.x % 32, n = *n_large;
  if (int(blockIdx.x) * kWarps >= n) return;
  __syncthreads();
  const TileDivider tile_of(in.grid.tile_size);
  for (int i = blockIdx.x * kWarps + threadIdx.x / 32; i < n; i += gridDim.x * kWarps) {
    const int32_t splat = large_splats[i];
    int64_t at = all_touched[splat].begin();
    const SplatShape shape = load_splat(in, splat);
    const TileRows<float> rows =
        find_tile_rows(shape.mean, shape.conic, shape.opacity, in.grid.height, tile_of);
    for (int top = rows.first; top <= rows.last && at < entries.capacity; top += 32) {
      const int ty = top + lane;
      int begin, end;
      Owned owned{};
      if (ty <= rows.last && rows.interval(ty, in.grid.width, tile_of, &begin, &end)) {
        owned = clip_to_owned(in.grid, shape.camera, ty, begin, end);
      }
      at += share_entries(max(owned.last - owned.first, 0), lane, [&](const LaneEntry& entry) {
        const int32_t first = __shfl_sync(kFullWarp, owned.first, entry.source);
        if (entry.valid) entries.write(at + entry.number, first + entry.k, splat, counts);
      });
    }
  }
  __syncthreads();
  add_counts(counts, bins, entries.histograms);
}

// tile_offsets[t] = the position of the first sorted entry whose tile is >= t. One warp per tile.
template <class Key>
__global__ void tile_offsets_kernel(const Key* keys, const int64_t* n_entries, TileGrid grid,
                                    int64_t* tile_offsets) {
  wait_for_earlier_kernels();
  const int64_t tile = (blockIdx.x * int64_t(kThreads) + threadIdx.x) / 32;
  const int lane = threadIdx.x % 32;
  if (tile > grid.count()) return;
  const int64_t wanted = (tile < grid.tile_end ? tile : grid.tile_end) - grid.tile_begin;
  int64_t low = 0, high = wanted <= 0 ? 0 : *n_entries;
  while (low < high) {  // a search with 32 parts: each lane tests the last entry of one part
    const int64_t part = (high - low + 31) / 32, at = low + (lane + 1) * part - 1;
    const bool less = at < high && int64_t(keys[at]) < wanted;
    low += __popc(__ballot_sync(kFullWarp, less)) * part;
    high = min(high, low + part - 1);
  }
  if (lane == 0) tile_offsets[tile] = low;
}

// The scratch memory of a call, except for the arrays of splats and entries.
template <class State> struct Counters {
  unsigned depth_blocks, tile_blocks, emit_blocks;
  // range_kernel sets all of these to zero, except for the ranges, which it writes.
  uint64_t *depth_histograms, *tile_histograms, *running, *turns;
  int64_t *n_splats, *n_entries;
  int32_t* n_large;
  int *dropped_bits, *width;
  State *depth_states, *tile_states;
  DepthRange* ranges;
  uint4* begin;
  int64_t n_zeros;  // in units of 16 bytes

  Counters(const Input& in, int64_t capacity, const TileDigits& digits, Workspace& workspace)
      : depth_blocks(blocks_for(in.n_splats, kSweepTile)),
        tile_blocks(blocks_for(capacity, kSweepTile)),
        emit_blocks(blocks_for(in.n_splats, kEmitSplats)) {
    const int64_t bytes = lay_out(nullptr, digits);
    begin = reinterpret_cast<uint4*>(workspace.allocate<std::byte>(bytes));
    lay_out(reinterpret_cast<std::byte*>(begin), digits);
  }

 private:
  // Sets the pointers to parts of `memory` (null: to null) and returns the number of bytes.
  int64_t lay_out(std::byte* memory, const TileDigits& digits) {
    int64_t bytes = 0;
    const auto take = [&]<class T>(T*& array, int64_t length) {
      array = memory ? reinterpret_cast<T*>(memory + bytes) : nullptr;
      bytes += (length * int64_t(sizeof(T)) + 15) / 16 * 16;
    };
    take(depth_histograms, kDepthPasses * kDepthBins);
    take(tile_histograms, digits.passes * TileDigits::kBins);
    take(running, int64_t{emit_blocks} + 1);
    take(turns, kDepthPasses + digits.passes);
    take(n_splats, 1);
    take(n_entries, 1);
    take(n_large, 1);
    take(dropped_bits, 1);
    take(width, 1);
    take(depth_states, int64_t{depth_blocks} * kDepthPasses * kDepthBins);
    take(tile_states, int64_t{tile_blocks} * digits.passes * TileDigits::kBins);
    n_zeros = bytes / 16;
    take(ranges, kRangeBlocks);
    return bytes;
  }
};

struct DepthOrder {
  Touched* touched;  // [P], the tiles of each splat
  int32_t* splats;   // [P], the splats sorted by (depth, id)
  int32_t* spare;    // [P], memory that the sort has used and that is free now
};

template <class State>
DepthOrder order_by_depth(const Input& in, const Counters<State>& counters, Workspace& workspace,
                          CudaStream stream) {
  const int64_t n = in.n_splats;
  auto [touched, keys_0, keys_1, splats_0, splats_1] =
      allocate_arrays<Touched, uint32_t, uint32_t, int32_t, int32_t>(n, workspace);
  uint32_t* const keys[] = {keys_0, keys_1};
  int32_t* const splats[] = {splats_0, splats_1};
  launch_early("intersect", range_kernel, {kRangeBlocks, kRangeThreads, stream}, in, counters.ranges,
               counters.begin, counters.n_zeros);
  launch_early("intersect", depth_keys_kernel,
               {resident_blocks(n, kDepthThreads, kDepthBlocks), kDepthThreads, stream}, in, counters.ranges,
               keys[0], touched, counters.depth_histograms, counters.dropped_bits, counters.width,
               counters.n_splats);
  int from = 0;
  for (int pass = 0; pass < kDepthPasses; ++pass, from = 1 - from) {
    const int64_t bins = pass * kDepthBins;
    sweep<kDepthBits>(SweepPass<uint32_t, State>{keys[from], pass ? splats[from] : nullptr, keys[1 - from],
                                                 splats[1 - from], counters.n_splats,
                                                 counters.depth_histograms + bins, counters.turns + pass,
                                                 counters.depth_states + bins * counters.depth_blocks, pass,
                                                 0, counters.width},
                      counters.depth_blocks, stream);
  }
  launch_early("intersect", order_ties_kernel, {blocks_for(n, kTieSplats), kDepthThreads, stream}, keys[from],
               splats[from], counters.n_splats, {in.depths, in.ids}, counters.dropped_bits);
  return {touched, splats[from], splats[1 - from]};
}

template <class Key, class State>
void list_splats(const Input& in, int64_t capacity, int32_t* isect_splats, int64_t* tile_offsets,
                 Workspace& workspace, CudaStream stream) {
  const TileDigits digits(in.grid.tile_end - in.grid.tile_begin);
  const Counters<State> counters(in, capacity, digits, workspace);
  const DepthOrder order = order_by_depth(in, counters, workspace, stream);
  auto [keys_0, keys_1, unsorted] = allocate_arrays<Key, Key, int32_t>(capacity, workspace);
  Key* const keys[] = {keys_0, keys_1};
  // The two buffers are chosen such that the last pass writes isect_splats.
  const bool even = digits.passes % 2 == 0;
  int32_t* const entries[] = {even ? isect_splats : unsorted, even ? unsorted : isect_splats};
  const Entries<Key> written{capacity, keys[0], entries[0], digits, counters.tile_histograms};
  launch_early("intersect", emit_kernel<Key>, {counters.emit_blocks, kThreads, stream}, in, order.touched,
               order.splats, counters.n_splats, RunningSum(counters.running), written, counters.n_entries,
               order.spare, counters.n_large);
  launch_early("intersect", emit_large_kernel<Key>,
               {resident_blocks(in.n_splats, kThreads / 32, kLargeBlocks), kThreads, stream}, in,
               order.touched, order.spare, counters.n_large, written);
  int from = 0;
  for (int pass = 0; pass < digits.passes; ++pass, from = 1 - from) {
    const int64_t bins = pass * TileDigits::kBins;
    sweep<TileDigits::kBits>(
        SweepPass<Key, State>{
            keys[from], entries[from], keys[1 - from], entries[1 - from], counters.n_entries,
            counters.tile_histograms + bins, counters.turns + kDepthPasses + pass,
            counters.tile_states + bins * counters.tile_blocks, pass, digits.width, nullptr},
        counters.tile_blocks, stream);
  }
  launch_early("intersect", tile_offsets_kernel<Key>,
               {blocks_for((in.grid.count() + 1) * 32, kThreads), kThreads, stream}, keys[from],
               counters.n_entries, in.grid, tile_offsets);
}

}  // namespace

template <> int64_t count_intersections<float>(const Input& in, Workspace& workspace, CudaStream stream) {
  if (in.n_splats == 0 || in.grid.tile_end <= in.grid.tile_begin) return 0;
  auto* counts = workspace.allocate<int32_t>(in.n_splats);
  auto* total = workspace.allocate<int64_t>(1);
  count_kernel<<<blocks_for(in.n_splats, kThreads), kThreads, 0, stream>>>(in, counts);
  check_launch("intersect");
  run_cub("intersect", workspace, [&](void* scratch, size_t& bytes) {
    return cub::DeviceReduce::Reduce(scratch, bytes, counts, total, in.n_splats, ::cuda::std::plus<int64_t>{},
                                     int64_t{0}, stream);
  });
  return read_back("intersect", total, stream);
}

template <>
int64_t intersect<float>(const Input& in, int64_t capacity, int32_t* isect_splats, int64_t* tile_offsets,
                         Workspace& workspace, CudaStream stream) {
  const int64_t n_tiles = in.grid.tile_end - in.grid.tile_begin;
  if (in.n_splats == 0 || capacity == 0 || n_tiles <= 0) {
    check(cudaMemsetAsync(tile_offsets, 0, (in.grid.count() + 1) * sizeof(int64_t), stream), "intersect");
    return capacity;
  }
  const bool small = in.n_splats < kSmallStates && capacity < kSmallStates;
  const auto list = [&](auto key, auto state) {
    list_splats<decltype(key), decltype(state)>(in, capacity, isect_splats, tile_offsets, workspace, stream);
  };
  if (n_tiles <= 65536) {
    small ? list(uint16_t{}, uint32_t{}) : list(uint16_t{}, uint64_t{});
  } else {
    small ? list(uint32_t{}, uint32_t{}) : list(uint32_t{}, uint64_t{});
  }
  return capacity;
}

}  // namespace blitzgs::cuda
