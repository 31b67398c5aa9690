// SPDX-License-Identifier: Apache-2.0
// Sums of block sums over the blocks of one launch, while these run.
#pragma once
#include <cstdint>
#include <cuda/atomic>

#include "common/warp.cuh"

namespace blitzgs::cuda {

// The sum over all blocks before a block, where each block has a sum in [0, 2^62). A block publishes its own
// sum. It then adds up the sums of its predecessors, backwards, until it meets one that has published the sum
// up to and including itself, and publishes its own such sum. No second launch is needed. Blocks are numbered
// in the order in which they start, so all predecessors of a block that waits run or have run.
class RunningSum {
 public:
  // zeros: one word for each block and one more, all zero.
  explicit RunningSum(std::uint64_t* zeros) : turn_(zeros), states_(zeros + 1) {}

  // Returns the block's number. All of its threads call this, and it is a barrier for them. A block may call
  // it again when it knows the sum before its last number; it then does the work of several blocks.
  __device__ int take_turn() const {
    __shared__ int turn;
    if (threadIdx.x == 0) turn = static_cast<int>(Word(*turn_).fetch_add(1, ::cuda::memory_order_relaxed));
    __syncthreads();
    return turn;
  }

  // Returns the sum before a block. All threads of the block call this, each looks at one predecessor at a
  // time, and it is a barrier for them.
  template <int kThreads>
  __device__ std::int64_t sum_before(int block, std::int64_t own) const {
    __shared__ std::int64_t parts[kThreads / 32];
    __shared__ bool ends[kThreads / 32];
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    if (threadIdx.x == 0) publish(block, kOwn, own);
    std::int64_t sum = 0;
    for (int end = block; end > 0; end -= kThreads) {
      const int at = end - 1 - static_cast<int>(threadIdx.x);
      std::uint64_t state = kThrough;  // before the first block the sum is 0
      do {
        if (at >= 0) state = Word(states_[at]).load(::cuda::memory_order_relaxed);
      } while (__any_sync(kFullWarp, state < kOwn));
      const unsigned through = __ballot_sync(kFullWarp, state >= kThrough);
      std::int64_t part = lane <= __ffs(through) - 1 || !through ? value(state) : 0;
      for (int step = 16; step > 0; step /= 2) part += __shfl_xor_sync(kFullWarp, part, step);
      __syncthreads();
      if (lane == 0) {
        parts[warp] = part;
        ends[warp] = through != 0;
      }
      __syncthreads();
      bool ended = false;
      for (int w = 0; w < kThreads / 32 && !ended; ++w) {
        sum += parts[w];
        ended = ends[w];
      }
      if (ended) break;
    }
    if (threadIdx.x == 0) publish(block, kThrough, sum + own);
    return sum;
  }

 private:
  using Word = ::cuda::atomic_ref<std::uint64_t, ::cuda::thread_scope_device>;
  // The two high bits say what the rest is: the block's own sum, or the sum up to and including this block.
  // Both are in one word, so no fence is needed to order them.
  static constexpr std::uint64_t kOwn = std::uint64_t{1} << 62, kThrough = std::uint64_t{2} << 62;

  __device__ static std::int64_t value(std::uint64_t state) {
    return static_cast<std::int64_t>(state & (kOwn - 1));
  }
  __device__ void publish(int block, std::uint64_t kind, std::int64_t sum) const {
    Word(states_[block]).store(kind | static_cast<std::uint64_t>(sum), ::cuda::memory_order_relaxed);
  }

  std::uint64_t *turn_, *states_;
};

}  // namespace blitzgs::cuda
