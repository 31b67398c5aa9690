// SPDX-License-Identifier: Apache-2.0
// The sum over all earlier turns, for blocks of a launch that take turns, while they run.
#pragma once
#include "common/running_sum.cuh"
#include "common/warp.cuh"

namespace blitzgs::cuda {

// Each turn has a sum in [0, 2^62). The first block that asks gets no turn: one of its warps adds the sums
// up, in order, for all other blocks, each of which reads a single word. The result arrives later than with
// RunningSum, but it costs the blocks no time if they have other work between publishing their sum and asking
// for the sum before them. Turns are numbered in the order in which they are asked for, so a block that waits
// for earlier turns waits for blocks that run.
class TurnSums {
 public:
  // zeros: one word for each turn and one more, all zero.
  explicit TurnSums(std::uint64_t* zeros) : asked_(zeros), states_(zeros + 1) {}

  // Called by one thread of a block: returns its next turn, or -1, in which case the block's first warp must
  // call add_up() and nothing else. Later turns wait until a turn that was taken is published.
  __device__ int next() const {
    return static_cast<int>(Word(*asked_).fetch_add(1, ::cuda::memory_order_relaxed)) - 1;
  }
  // The same, called by all threads of a block, and a barrier for them.
  __device__ int first() const {
    __shared__ int turn;
    if (threadIdx.x == 0) turn = next();
    __syncthreads();
    return turn;
  }
  // Publishes the sum of a turn; called by one thread.
  __device__ void publish(int turn, std::int64_t own) const { set(turn, kOwn, own); }
  // Waits for the sum of all earlier turns and returns it; called by one thread.
  __device__ std::int64_t before(int turn) const {
    std::uint64_t state;
    do state = look(turn);
    while (state < kBefore);
    return value(state);
  }

  // Adds up the sums of turns [0, n), all of which are taken at some time; called by one warp.
  __device__ void add_up(int n) const {
    constexpr int kEach = 4;  // turns that a lane reads at a time
    const int lane = threadIdx.x % 32;
    std::int64_t sum = 0;
    for (int done = 0; done < n;) {
      const int begin = done + kEach * lane;
      std::uint64_t states[kEach];
#pragma unroll
      for (int k = 0; k < kEach; ++k) states[k] = begin + k < n ? look(begin + k) : 0;
      int ready = 0;
      std::int64_t own = 0;
#pragma unroll
      for (int k = 0; k < kEach; ++k) {
        if (ready < k || states[k] == 0) continue;
        ready = k + 1;
        own += value(states[k]);
      }
      // Turns behind the first one that is not published yet have to wait for it.
      const unsigned short_of = __ballot_sync(kFullWarp, ready < kEach);
      const int last = short_of ? __ffs(short_of) - 1 : 31;
      if (lane > last) own = 0;
      const std::int64_t until = sum_of_lanes_until(own, lane);
      std::int64_t before = sum + until - own;
#pragma unroll
      for (int k = 0; k < kEach; ++k) {
        if (lane > last || k >= ready) break;
        set(begin + k, kBefore, before);
        before += value(states[k]);
      }
      sum += __shfl_sync(kFullWarp, until, 31);
      done += kEach * last + __shfl_sync(kFullWarp, ready, last);
    }
  }

 private:
  using Word = ::cuda::atomic_ref<std::uint64_t, ::cuda::thread_scope_device>;
  // The two high bits say what the rest is: the turn's own sum, or the sum of all earlier turns. Both are in
  // one word, so no fence is needed to order them.
  static constexpr std::uint64_t kOwn = std::uint64_t{1} << 62, kBefore = std::uint64_t{2} << 62;

  __device__ static std::int64_t value(std::uint64_t state) {
    return static_cast<std::int64_t>(state & (kOwn - 1));
  }
  __device__ std::uint64_t look(int turn) const {
    return Word(states_[turn]).load(::cuda::memory_order_relaxed);
  }
  __device__ void set(int turn, std::uint64_t kind, std::int64_t sum) const {
    Word(states_[turn]).store(kind | static_cast<std::uint64_t>(sum), ::cuda::memory_order_relaxed);
  }

  std::uint64_t *asked_, *states_;
};

}  // namespace blitzgs::cuda
