// SPDX-License-Identifier: Apache-2.0
// One pass of a stable radix sort in one launch: pairs of a key and a value go to where a digit of the key
// wants them. How often each digit occurs was counted before, by the kernel that wrote the keys; what the
// blocks before a block hold of each digit is added up while they run (decoupled look-back), several
// predecessors at a time: with a few hundred blocks, all of them running at once, the look-back is what a
// pass would otherwise wait for. The number of pairs is read on the device.
#pragma once
#include <cstdint>
#include <cuda/atomic>

#include "common/cuda_check.h"
#include "intersect/running_sum.cuh"

namespace blitzgs::cuda {

inline constexpr int kSweepThreads = 256, kSweepItems = 16, kSweepTile = kSweepThreads * kSweepItems;
inline constexpr int kSweepWindow = 8;  // predecessors looked at together

// State: an unsigned integer whose two high bits say what the rest counts, so n_items < 2^30 for 32 bits.
template <class Key, class State>
struct SweepPass {
  const Key* keys;
  const std::int32_t* values;  // null: the positions of the keys
  Key* sorted_keys;
  std::int32_t* sorted_values;
  const std::int64_t* n_items;
  const std::uint64_t* histogram;  // [bins] of this digit
  std::uint64_t* turn;             // zero before
  State* states;                   // [blocks, bins] zeros before
  int index;                       // of this digit, the lowest is 0
  int width;                       // bits of all digits
  const int* known_width;          // null, or their width where only the device knows it
};

// Adds the counts of a block to those of all; called by all its threads.
__device__ __forceinline__ void add_counts(const std::uint32_t* counts, int bins, std::uint64_t* histogram) {
  using Word = ::cuda::atomic_ref<std::uint64_t, ::cuda::thread_scope_device>;
  for (int bin = threadIdx.x; bin < bins; bin += blockDim.x) {
    if (counts[bin]) Word(histogram[bin]).fetch_add(counts[bin], ::cuda::memory_order_relaxed);
  }
}

// What the blocks before `block` hold of each of a thread's bins, which begin at states[0] in block 0.
template <int kBins, int kOwned, class State>
__device__ __forceinline__ void count_before(const State* states, unsigned block, State (&sums)[kOwned]) {
  using Word = ::cuda::atomic_ref<const State, ::cuda::thread_scope_device>;
  constexpr int kBits = 8 * sizeof(State);
  bool through[kOwned] = {}, all = block == 0;
  for (std::int64_t end = block; !all; end -= kSweepWindow) {
    State seen[kSweepWindow][kOwned];
#pragma unroll
    for (int k = 0; k < kSweepWindow; ++k) {
#pragma unroll
      for (int j = 0; j < kOwned; ++j) {
        seen[k][j] = State{2} << (kBits - 2);  // in front of the first block there is nothing
        if (end > k) seen[k][j] = Word(states[(end - 1 - k) * kBins + j]).load(::cuda::memory_order_relaxed);
      }
    }
    all = true;
#pragma unroll
    for (int j = 0; j < kOwned; ++j) {
#pragma unroll
      for (int k = 0; k < kSweepWindow; ++k) {
        if (through[j]) continue;
        while (seen[k][j] >> (kBits - 2) == 0) {
          seen[k][j] = Word(states[(end - 1 - k) * kBins + j]).load(::cuda::memory_order_relaxed);
        }
        sums[j] += seen[k][j] & ((State{1} << (kBits - 2)) - 1);
        through[j] = seen[k][j] >> (kBits - 1) != 0;
      }
      all &= through[j];
    }
  }
}

template <int kBits, class Key, class State>
__global__ void __launch_bounds__(kSweepThreads, 4) sweep_kernel(const SweepPass<Key, State> pass) {
  constexpr int kBins = 1 << kBits, kWarps = kSweepThreads / 32, kOwned = kBins / kSweepThreads;
  static_assert(kOwned >= 1);
  // The flags of a state: this block's own count, or that of all blocks through this one.
  constexpr State kOwn = State{1} << (8 * sizeof(State) - 2), kThrough = kOwn << 1;
  __shared__ union {
    std::uint32_t counts[kWarps][kBins];
    struct {
      Key keys[kSweepTile];
      std::int32_t values[kSweepTile];
    } staged;
  } shared;
  __shared__ std::uint64_t targets[kBins], sums_everywhere[kWarps];
  __shared__ std::uint32_t sums_here[kWarps];
  __shared__ unsigned turn;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  if (threadIdx.x == 0) {
    using Turn = ::cuda::atomic_ref<std::uint64_t, ::cuda::thread_scope_device>;  // predecessors have started
    turn = static_cast<unsigned>(Turn(*pass.turn).fetch_add(1, ::cuda::memory_order_relaxed));
  }
  std::uint64_t everywhere[kOwned];
#pragma unroll
  for (int j = 0; j < kOwned; ++j) everywhere[j] = pass.histogram[threadIdx.x * kOwned + j];
  const std::int64_t n = *pass.n_items;
  const int width = pass.known_width ? *pass.known_width : pass.width, shift = pass.index * width;
  const auto digit_of = [&](Key key) { return static_cast<unsigned>(key) >> shift & ((1u << width) - 1); };
  for (int bin = lane; bin < kBins; bin += 32) shared.counts[warp][bin] = 0;
  __syncthreads();
  const unsigned block = turn;
  const std::int64_t first = block * static_cast<std::int64_t>(kSweepTile);
  if (first >= n) return;
  const int n_here = n - first < kSweepTile ? static_cast<int>(n - first) : kSweepTile;

  // A warp's pairs follow each other, so that equal digits keep their order. What is behind the last pair
  // has the largest digit and is dropped at the end.
  const int begin = warp * 32 * kSweepItems + lane;
  Key keys[kSweepItems];
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const int at = begin + 32 * k;
    keys[k] = at < n_here ? pass.keys[first + at] : static_cast<Key>(~Key{0});
  }
  std::uint32_t places[kSweepItems];
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const unsigned digit = digit_of(keys[k]);
    unsigned peers = kFullWarp;
#pragma unroll
    for (int bit = 0; bit < kBits; ++bit) {
      const bool set = digit >> bit & 1u;
      const unsigned with = __ballot_sync(kFullWarp, set);
      peers &= set ? with : ~with;
    }
    const unsigned earlier = peers & ((1u << lane) - 1);
    const std::uint32_t count = shared.counts[warp][digit];
    places[k] = count + __popc(earlier);
    __syncwarp();
    if (!earlier) shared.counts[warp][digit] = count + __popc(peers);
    __syncwarp();
  }
  __syncthreads();

  using Word = ::cuda::atomic_ref<State, ::cuda::thread_scope_device>;
  State* const states = pass.states + threadIdx.x * kOwned;
  State* const own_states = states + block * static_cast<std::int64_t>(kBins);
  std::uint32_t counts[kOwned] = {}, here = 0;
  std::uint64_t of_all = 0;
#pragma unroll
  for (int j = 0; j < kOwned; ++j) {
    for (int w = 0; w < kWarps; ++w) counts[j] += shared.counts[w][threadIdx.x * kOwned + j];
    Word(own_states[j]).store((block ? kOwn : kThrough) | counts[j], ::cuda::memory_order_relaxed);
    here += counts[j];
    of_all += everywhere[j];
  }
  const std::uint32_t until_here = sum_of_lanes_until(here, lane);
  const std::uint64_t until_everywhere = sum_of_lanes_until(of_all, lane);
  if (lane == 31) {
    sums_here[warp] = until_here;
    sums_everywhere[warp] = until_everywhere;
  }
  __syncthreads();
  std::uint32_t start = until_here - here;           // of the thread's first bin in this block
  std::uint64_t target = until_everywhere - of_all;  // and of all pairs
  for (int w = 0; w < warp; ++w) {
    start += sums_here[w];
    target += sums_everywhere[w];
  }
#pragma unroll
  for (int j = 0; j < kOwned; ++j) {
    const int bin = threadIdx.x * kOwned + j;
    targets[bin] = target - start;
    target += everywhere[j];
    for (int w = 0; w < kWarps; ++w) {
      const std::uint32_t count = shared.counts[w][bin];
      shared.counts[w][bin] = start;
      start += count;
    }
  }
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) places[k] += shared.counts[warp][digit_of(keys[k])];
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) shared.staged.keys[places[k]] = keys[k];
  std::int32_t values[kSweepItems];
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const int at = begin + 32 * k;
    values[k] = static_cast<std::int32_t>(first + at);
    if (pass.values && at < n_here) values[k] = pass.values[first + at];
  }

  State before[kOwned] = {};
  count_before<kBins>(states, block, before);
#pragma unroll
  for (int j = 0; j < kOwned; ++j) {
    if (block) {
      Word(own_states[j]).store(kThrough | (before[j] + counts[j]), ::cuda::memory_order_relaxed);
    }
    targets[threadIdx.x * kOwned + j] += before[j];
  }
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) shared.staged.values[places[k]] = values[k];
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const int at = threadIdx.x + k * kSweepThreads;
    if (at >= n_here) break;
    const Key key = shared.staged.keys[at];
    const std::uint64_t target_at = targets[digit_of(key)] + at;
    pass.sorted_keys[target_at] = key;
    pass.sorted_values[target_at] = shared.staged.values[at];
  }
}

}  // namespace blitzgs::cuda
