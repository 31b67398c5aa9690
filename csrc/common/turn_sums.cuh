// SPDX-License-Identifier: Apache-2.0
// What the blocks of a launch that take turns found in the turns before one, while they run.
#pragma once
#include "common/running_sum.cuh"

namespace blitzgs::cuda {

// Each turn has a sum in [0, 2^62). The first block to ask gets no turn: a warp of it adds the sums up, in
// order, for all others, each of which looks at a single word. That takes longer than looking back as with
// RunningSum, but nothing of the blocks' time while they have something else to do between publishing and
// asking. Turns are numbered as they are asked for, so whoever waits for those before waits for blocks that
// run.
class TurnSums {
 public:
  // zeros: one for each turn and one more.
  explicit TurnSums(std::uint64_t* zeros) : asked_(zeros), states_(zeros + 1) {}

  // For one thread of a block: its next turn, or -1: add_up() is all that is left to do for its first warp. A
  // turn that was taken holds up those behind it until it is published.
  __device__ int next() const {
    return static_cast<int>(Word(*asked_).fetch_add(1, ::cuda::memory_order_relaxed)) - 1;
  }
  // The same for all threads of a block, and a barrier for them.
  __device__ int first() const {
    __shared__ int turn;
    if (threadIdx.x == 0) turn = next();
    __syncthreads();
    return turn;
  }
  // By one thread.
  __device__ void publish(int turn, std::int64_t own) const { set(turn, kOwn, own); }
  // By one thread: the sum of the turns before, for which it waits.
  __device__ std::int64_t before(int turn) const {
    std::uint64_t state;
    do state = look(turn);
    while (state < kBefore);
    return value(state);
  }

  // By one warp. Turns [0, n) are all taken some time.
  __device__ void add_up(int n) const {
    constexpr int kEach = 4;  // turns that a lane looks at
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
      // Those behind the first that is not there yet have to wait for it.
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
  // In the two high bits, what the rest is: the turn's own sum, or that of all before it. State and sum are
  // one word, so no fence orders them.
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
