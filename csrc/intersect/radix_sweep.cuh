// SPDX-License-Identifier: Apache-2.0
// One pass of a stable radix sort in one launch: it sorts pairs of a key and a value by one digit of the key.
// The kernel that wrote the keys has counted how often each digit occurs. Each block adds up the counts of
// each digit in the blocks before it while these run (decoupled look-back, Merrill & Garland 2016; for a
// radix sort, Adinets & Merrill 2022). It reads the states of several predecessors at a time, because a pass
// has only a few hundred blocks, which all run at once, and would spend most of its time on the look-back.
#pragma once
#include "common/cuda.cuh"

namespace blitzgs::cuda {

inline constexpr int kSweepThreads = 512, kSweepItems = 16, kSweepTile = kSweepThreads * kSweepItems;
inline constexpr int kSweepWindow = 4;  // predecessors whose states are read at a time

// State: an unsigned integer. The two high bits say what the other bits count (sweep_kernel), so 32-bit
// states need n_items < kSmallStates.
template <class Key, class State> struct SweepPass {
  const Key* keys;
  const int32_t* values;  // null: the positions of the keys
  Key* sorted_keys;
  int32_t* sorted_values;
  const int64_t* n_items;
  const uint64_t* histogram;  // [bins], the number of keys for each value of this digit
  uint64_t* turn;             // zero before the launch
  State* states;              // [blocks, bins], zeros before the launch
  int index;                  // the index of this digit; the lowest digit has index 0
  int width;                  // bits of each digit
  const int* known_width;     // null, or the width in device memory if the host does not know it
};

// Adds the counts of a block to the histogram of the whole launch. All threads of the block call this.
__device__ __forceinline__ void add_counts(const uint32_t* counts, int bins, uint64_t* histogram) {
  using Word = ::cuda::atomic_ref<uint64_t, ::cuda::thread_scope_device>;
  for (int bin = threadIdx.x; bin < bins; bin += blockDim.x) {
    if (counts[bin]) Word(histogram[bin]).fetch_add(counts[bin], ::cuda::memory_order_relaxed);
  }
}

// Returns how many items the blocks before `block` have in one bin; states[0] is the bin's state in block 0.
template <int kBins, class State>
__device__ __forceinline__ State count_before(const State* states, unsigned block) {
  using Word = ::cuda::atomic_ref<const State, ::cuda::thread_scope_device>;
  constexpr int kBits = 8 * sizeof(State);
  State sum = 0;
  for (int64_t end = block; end > 0; end -= kSweepWindow) {
    State seen[kSweepWindow];
#pragma unroll
    for (int k = 0; k < kSweepWindow; ++k) {
      seen[k] = State{2} << (kBits - 2);  // before the first block the sum is 0
      if (end > k) seen[k] = Word(states[(end - 1 - k) * kBins]).load(::cuda::memory_order_relaxed);
    }
#pragma unroll
    for (int k = 0; k < kSweepWindow; ++k) {
      while (seen[k] >> (kBits - 2) == 0) {
        seen[k] = Word(states[(end - 1 - k) * kBins]).load(::cuda::memory_order_relaxed);
      }
      sum += seen[k] & ((State{1} << (kBits - 2)) - 1);
      if (seen[k] >> (kBits - 1)) return sum;
    }
  }
  return sum;
}

// Returns the lanes whose values have the same low bits as this lane's. It is written in PTX because the
// compiler spends 7 instructions on each bit.
template <int kBits> __device__ __forceinline__ unsigned lanes_with_same(unsigned value) {
  unsigned lanes = kFullWarp;
#pragma unroll
  for (int bit = 0; bit < kBits; ++bit) {
    unsigned with;
    asm volatile(
        "{ .reg .pred set; .reg .b32 masked;\n"
        "and.b32 masked, %1, %2; setp.ne.u32 set, masked, 0;\n"
        "vote.sync.ballot.b32 %0, set, 0xffffffff; @!set not.b32 %0, %0; }"
        : "=r"(with)
        : "r"(value), "r"(1u << bit));
    lanes &= with;
  }
  return lanes;
}

// One pass: sorts keys and values [n_items] stably by one digit of kBits bits at most. A block sorts
// kSweepTile consecutive pairs, kSweepItems per thread; in the steps over bins a thread is a bin.
template <int kBits, class Key, class State>
__global__ void __launch_bounds__(kSweepThreads, 2) sweep_kernel(const SweepPass<Key, State> pass) {
  constexpr int kBins = 1 << kBits, kWarps = kSweepThreads / 32;
  static_assert(kBins <= kSweepThreads);
  // The two flags of a state: the other bits are the block's own count, or that of all blocks up to this one.
  constexpr State kOwn = State{1} << (8 * sizeof(State) - 2), kThrough = kOwn << 1;
  extern __shared__ int32_t staged_values[];
  auto* const staged_keys = reinterpret_cast<Key*>(staged_values + kSweepTile);
  // [warps, bins], the counts of each warp; the keys reuse this memory later.
  auto* const counts = reinterpret_cast<uint32_t*>(staged_values + kSweepTile);
  __shared__ State targets[kBins], sums_everywhere[kWarps];
  __shared__ uint32_t sums_here[kWarps];
  __shared__ unsigned turn;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int bin = threadIdx.x;  // valid in threads below the number of bins
  for (int i = lane; i < kBins; i += 32) counts[warp * kBins + i] = 0;
  wait_for_earlier_kernels();
  if (threadIdx.x == 0) {
    // A block takes its number here, so that all blocks with smaller numbers have started.
    using Turn = ::cuda::atomic_ref<uint64_t, ::cuda::thread_scope_device>;
    turn = unsigned(Turn(*pass.turn).fetch_add(1, ::cuda::memory_order_relaxed));
  }
  const State count_everywhere = bin < kBins ? State(pass.histogram[bin]) : 0;
  const int64_t n = *pass.n_items;
  const int width = pass.known_width ? *pass.known_width : pass.width, shift = pass.index * width;
  const auto digit_of = [&](Key key) { return unsigned(key) >> shift & ((1u << width) - 1); };
  __syncthreads();
  const unsigned block = turn;
  const int64_t first = block * int64_t(kSweepTile);
  if (first >= n) return;
  const int n_here = n - first < kSweepTile ? int(n - first) : kSweepTile;

  // A warp handles consecutive pairs, so that pairs of equal digits keep their order. Items after the last
  // pair get the largest digit, so that they come last, and are not written.
  const int begin = warp * 32 * kSweepItems + lane;
  Key keys[kSweepItems];
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const int at = begin + 32 * k;
    keys[k] = at < n_here ? pass.keys[first + at] : Key(~Key{0});
  }
  uint32_t places[kSweepItems];
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const unsigned digit = digit_of(keys[k]);
    const unsigned peers = lanes_with_same<kBits>(digit);
    const unsigned earlier = peers & ((1u << lane) - 1);
    const uint32_t count = counts[warp * kBins + digit];
    places[k] = count + __popc(earlier);
    __syncwarp();
    if (!earlier) counts[warp * kBins + digit] = count + __popc(peers);
    __syncwarp();
  }
  __syncthreads();

  using Word = ::cuda::atomic_ref<State, ::cuda::thread_scope_device>;
  State* const states = pass.states + bin;
  State* const own_state = states + block * int64_t(kBins);
  uint32_t count_here = 0;
  if (bin < kBins) {
#pragma unroll
    for (int w = 0; w < kWarps; ++w) count_here += counts[w * kBins + bin];
    Word(*own_state).store((block ? kOwn : kThrough) | count_here, ::cuda::memory_order_relaxed);
  }
  const uint32_t sum_here = sum_of_lanes_until(count_here, lane);
  const State sum_everywhere = sum_of_lanes_until(count_everywhere, lane);
  if (lane == 31) {
    sums_here[warp] = sum_here;
    sums_everywhere[warp] = sum_everywhere;
  }
  __syncthreads();
  State target = sum_everywhere - count_everywhere;
  if (bin < kBins) {
    uint32_t start = sum_here - count_here;  // the position of the bin's first pair in this block
    for (int w = 0; w < warp; ++w) {
      start += sums_here[w];
      target += sums_everywhere[w];
    }
    target -= start;
#pragma unroll
    for (int w = 0; w < kWarps; ++w) {
      const uint32_t count = counts[w * kBins + bin];
      counts[w * kBins + bin] = start;
      start += count;
    }
  }
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) places[k] += counts[warp * kBins + digit_of(keys[k])];
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) staged_keys[places[k]] = keys[k];
  int32_t values[kSweepItems];
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const int at = begin + 32 * k;
    values[k] = int32_t(first + at);
    if (pass.values && at < n_here) values[k] = pass.values[first + at];
  }
  if (bin < kBins) {
    const State before = count_before<kBins>(states, block);
    if (block) Word(*own_state).store(kThrough | (before + count_here), ::cuda::memory_order_relaxed);
    targets[bin] = target + before;
  }
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) staged_values[places[k]] = values[k];
  __syncthreads();
  // The pairs of one digit are neighbours in shared memory, so neighbouring threads write side by side.
#pragma unroll
  for (int k = 0; k < kSweepItems; ++k) {
    const int at = threadIdx.x + k * kSweepThreads;
    if (at >= n_here) break;
    const Key key = staged_keys[at];
    const State to = targets[digit_of(key)] + at;
    pass.sorted_keys[to] = key;
    pass.sorted_values[to] = staged_values[at];
  }
}

template <int kBits, class Key, class State>
void sweep(const SweepPass<Key, State>& pass, unsigned blocks, CudaStream stream) {
  constexpr size_t kCounts = kSweepThreads / 32 * sizeof(uint32_t) << kBits;
  constexpr size_t kBytes = kSweepTile * sizeof(int32_t) + std::max(kSweepTile * sizeof(Key), kCounts);
  launch_early("radix sweep", sweep_kernel<kBits, Key, State>, {blocks, kSweepThreads, stream, kBytes}, pass);
}

}  // namespace blitzgs::cuda
