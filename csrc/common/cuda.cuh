// SPDX-License-Identifier: Apache-2.0
// Helpers of all CUDA kernels: launches, and sums over the threads of a warp, a block and a grid. This header
// does not include torch.
#pragma once
#include <cuda_runtime.h>
#include <algorithm>
#include <array>
#include <atomic>
#include <cuda/atomic>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "common/kernel.h"

// A test build takes the branches of other GPUs and sizes (CONTRIBUTING.md): BLITZGS_SM80_BRANCHES compiles
// the code for GPUs before sm_90 for all GPUs, BLITZGS_SMALL_STATES lowers the number of items from which
// sorts take 64-bit states. Tests ask the library for both (build_cuda.cu).

#ifndef BLITZGS_SM80_BRANCHES
#define BLITZGS_SM80_BRANCHES 0
#endif
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900 && !BLITZGS_SM80_BRANCHES
#define BLITZGS_SM90 1
#else
#define BLITZGS_SM90 0
#endif

#ifndef BLITZGS_SMALL_STATES
#define BLITZGS_SMALL_STATES (1 << 30)  // 32-bit states leave 30 bits for counts
#endif

namespace blitzgs::cuda {

// Sorts of fewer items have 32-bit states.
inline constexpr int64_t kSmallStates = BLITZGS_SMALL_STATES;
static_assert(kSmallStates <= 1 << 30);

inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) {
    throw std::runtime_error(std::string("blitzgs: CUDA error in ") + what + ": " +
                             cudaGetErrorString(status));
  }
}

inline void check_launch(const char* kernel) { check(cudaGetLastError(), kernel); }

// The number of blocks for n items; callers skip the launch when n is 0.
inline unsigned blocks_for(int64_t n, int threads) { return unsigned((n + threads - 1) / threads); }

// The number of multiprocessors of the current device, for launches with as many blocks as run at a time.
inline int multiprocessors() {
  int device = 0, count = 0;
  check(cudaGetDevice(&device), "multiprocessors");
  check(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device), "multiprocessors");
  return count;
}

// The number of blocks for n items of a kernel that loops over them: at most `resident` a multiprocessor.
inline unsigned resident_blocks(int64_t n, int threads, int resident) {
  return unsigned(std::min((n + threads - 1) / threads, int64_t{resident} * multiprocessors()));
}

// Waits for a value in device memory.
template <class T> T read_back(const char* what, const T* value, CudaStream stream) {
  T found{};
  check(cudaMemcpyAsync(&found, value, sizeof(T), cudaMemcpyDeviceToHost, stream), what);
  check(cudaStreamSynchronize(stream), what);
  return found;
}

// Calls a function of CUB with scratch memory: run(null, bytes) first sets the bytes that it needs.
template <class Run> void run_cub(const char* what, Workspace& workspace, const Run& run) {
  size_t bytes = 0;
  check(run(nullptr, bytes), what);
  check(run(workspace.allocate_bytes(bytes), bytes), what);
}

__device__ __forceinline__ int64_t atomic_add(int64_t* sum, int64_t amount) {
  return int64_t(
      atomicAdd(reinterpret_cast<unsigned long long*>(sum), static_cast<unsigned long long>(amount)));
}

// Launches that avoid the gap of 1.2 to 2.5 us between two kernels of a stream (programmatic dependent
// launch, sm_90 and later): the device places a kernel that was launched by launch_early when all blocks of
// the kernel before it have ended, while that kernel's memory is still being flushed. The rules:
//
// - Each block calls wait_for_earlier_kernels() before its first access to global memory, reads and writes
//   alike, and before any return: an earlier kernel may still read what this one would overwrite.
// - The call returns when the kernel before it has ended and its writes are visible. That one waited itself,
//   or was launched plainly and so began after all earlier kernels had ended. Hence all earlier kernels have
//   ended, and memory that the allocator reuses in stream order is safe.
// - Plain launches, copies, events and kernels of other libraries wait until the kernel before them has
//   ended.
// - No kernel lets the next one in before its own blocks end (griddepcontrol.launch_dependents): a waiting
//   block occupies a multiprocessor, which a kernel that spins for another GPU may need, and spreads the
//   blocks of the next kernel unevenly (docs/decisions.md).

__device__ __forceinline__ void wait_for_earlier_kernels() {
#if BLITZGS_SM90
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Whether wait_for_earlier_kernels() waits on the current device. Code that was compiled for an older
// architecture and translated at load time does not; all kernels are compiled alike, so one of them tells.
inline bool can_launch_early(const void* kernel) {
  if constexpr (BLITZGS_SM80_BRANCHES) return false;
  enum : signed char { kUnknown, kNo, kYes };
  static std::array<std::atomic<signed char>, 64> known{};  // by device
  int device = 0;
  check(cudaGetDevice(&device), "launch");
  if (device >= int(known.size())) return false;
  signed char answer = known[device].load(std::memory_order_relaxed);
  if (answer == kUnknown) {
    cudaFuncAttributes code{};
    check(cudaFuncGetAttributes(&code, kernel), "launch");
    answer = code.ptxVersion >= 90 ? kYes : kNo;
    known[device].store(answer, std::memory_order_relaxed);
  }
  return answer == kYes;
}

// Lets a kernel have this much dynamic shared memory, which may be more than the 48 KiB of the default.
inline void allow_shared_bytes(const char* what, const void* kernel, size_t bytes) {
  const auto size = int(bytes);
  if (size > 0) check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, size), what);
}

struct LaunchShape {
  dim3 blocks;
  unsigned threads;
  CudaStream stream;
  size_t shared_bytes = 0;
};

// Launches a kernel that calls wait_for_earlier_kernels(). A failure names `what`.
template <class... Parameters>
void launch_early(const char* what, void (*kernel)(Parameters...), const LaunchShape& shape,
                  const std::type_identity_t<Parameters>&... arguments) {
  const auto* address = reinterpret_cast<const void*>(kernel);
  allow_shared_bytes(what, address, shape.shared_bytes);
  cudaLaunchAttribute early{};
  early.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  early.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = shape.blocks;
  config.blockDim = dim3(shape.threads);
  config.dynamicSmemBytes = shape.shared_bytes;
  config.stream = shape.stream;
  config.attrs = &early;
  config.numAttrs = can_launch_early(address) ? 1 : 0;
  cudaLaunchKernelEx(&config, kernel, arguments...);
  check_launch(what);
}

// Sets counters [n] to zero between kernels that are launched early, one thread per counter. A memset would
// bring back the gaps before and after it.
static __global__ void zero_kernel(int32_t* counters, int64_t n) {
  wait_for_earlier_kernels();
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  if (i < n) counters[i] = 0;
}

inline void zero(const char* what, int32_t* counters, int64_t n, CudaStream stream) {
  launch_early(what, zero_kernel, {blocks_for(n, 256), 256, stream}, counters, n);
}

inline constexpr unsigned kFullWarp = 0xffffffffu;  // the mask of warp functions that all lanes call

// Returns the sum of `value` over the lanes up to and including this one.
template <class T> __device__ __forceinline__ T sum_of_lanes_until(T value, int lane) {
#pragma unroll
  for (int step = 1; step < 32; step *= 2) {
    const T before = __shfl_up_sync(kFullWarp, value, step);
    if (lane >= step) value += before;
  }
  return value;
}

// Transposes the 32 x 32 bits of a warp: bit r of the result of lane c is bit c of the argument of lane r.
__device__ __forceinline__ uint32_t transpose_bits(uint32_t bits, int lane) {
  constexpr uint32_t kLow[5] = {0x55555555u, 0x33333333u, 0x0f0f0f0fu, 0x00ff00ffu, 0x0000ffffu};
#pragma unroll
  for (int i = 4; i >= 0; --i) {
    const int step = 1 << i;
    const bool high = lane & step;
    const uint32_t other = __shfl_xor_sync(kFullWarp, bits, step);
    const uint32_t keep = high ? ~kLow[i] : kLow[i];
    const uint32_t moved = __funnelshift_l(other, other, high ? 32 - step : step);
    bits = (bits & keep) | (moved & ~keep);
  }
  return bits;
}

// Returns the sum of `value` over a block of THREADS threads on thread 0, and 0 on the others.
template <int THREADS> __device__ double block_sum(double value) {
  __shared__ double warps[THREADS / 32];
  for (int offset = 16; offset > 0; offset /= 2) value += __shfl_down_sync(kFullWarp, value, offset);
  __syncthreads();
  if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = value;
  __syncthreads();
  double total = 0;
  if (threadIdx.x == 0) {
    for (const double part : warps) total += part;
  }
  return total;
}

// The memory of a prefix sum over the blocks of a launch while they run: a counter from which blocks take
// numbers, and a state for each number. The two high bits of a state say what the rest is: the own sum of
// that number, or what the sum's class says. In one word, they need no fence. Sums are in [0, 2^62).
class SumStates {
 public:
  // zeros: one word for each number and one more, all zero.
  explicit SumStates(uint64_t* zeros) : taken_(zeros), states_(zeros + 1) {}

 protected:
  static constexpr uint64_t kOwn = uint64_t{1} << 62, kOthers = uint64_t{2} << 62;

  __device__ int take() const { return int(Word(*taken_).fetch_add(1, ::cuda::memory_order_relaxed)); }
  __device__ uint64_t look(int number) const {
    return Word(states_[number]).load(::cuda::memory_order_relaxed);
  }
  __device__ void set(int number, uint64_t kind, int64_t sum) const {
    Word(states_[number]).store(kind | uint64_t(sum), ::cuda::memory_order_relaxed);
  }
  __device__ static int64_t value(uint64_t state) { return int64_t(state & (kOwn - 1)); }

 private:
  using Word = ::cuda::atomic_ref<uint64_t, ::cuda::thread_scope_device>;
  uint64_t *taken_, *states_;
};

// A prefix sum over the blocks of a launch while they run, without a second launch (decoupled look-back,
// Merrill & Garland 2016). A block first publishes its own sum. It then adds up the sums of its predecessors,
// from the nearest to the farthest, until it finds one that has published the sum up to and including itself
// (kOthers). At last the block publishes its own such sum. Blocks are numbered in the order in which they
// start, so all predecessors of a waiting block run or have run.
class RunningSum : public SumStates {
 public:
  using SumStates::SumStates;

  // Returns the block's number. All of its threads call this, and it is a barrier for them. A block may call
  // it again when it knows the sum before its last number; it then does the work of several blocks.
  __device__ int take_turn() const {
    __shared__ int turn;
    if (threadIdx.x == 0) turn = take();
    __syncthreads();
    return turn;
  }

  // Publishes the sum `own` of a block and returns the sum over all blocks before it. All threads of the
  // block call this, and each reads the state of one predecessor at a time. It is no barrier for block 0,
  // which has no predecessor, so a caller has a barrier of its own before its next take_turn().
  template <int kThreads> __device__ int64_t sum_before(int block, int64_t own) const {
    __shared__ int64_t parts[kThreads / 32];
    __shared__ bool ends[kThreads / 32];
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    if (threadIdx.x == 0) set(block, kOwn, own);
    int64_t sum = 0;
    for (int end = block; end > 0; end -= kThreads) {
      const int at = end - 1 - int(threadIdx.x);
      uint64_t state = kOthers;  // before the first block the sum is 0
      do {
        if (at >= 0) state = look(at);
      } while (__any_sync(kFullWarp, state < kOwn));
      const unsigned through = __ballot_sync(kFullWarp, state >= kOthers);
      int64_t part = lane <= __ffs(through) - 1 || !through ? value(state) : 0;
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
    if (threadIdx.x == 0) set(block, kOthers, sum + own);
    return sum;
  }
};

// Another prefix sum: a block takes turns (batches of work) and gets the sum over all earlier turns
// (kOthers). The first block that calls next() gets no turn: one of its warps adds up the sums, and each
// other block reads one word. The result comes later than with RunningSum, but costs a block nothing that has
// other work between publish() and before(). Turns are numbered in the order of the calls of next(), so a
// block waits for blocks that run.
class TurnSums : public SumStates {
 public:
  using SumStates::SumStates;

  // Called by one thread of a block: returns its next turn, or -1, in which case the block's first warp must
  // call add_up() and nothing else. Later turns wait until a turn that was taken is published.
  __device__ int next() const { return take() - 1; }
  // next(), but called by all threads of a block; it is a barrier for them.
  __device__ int first() const {
    __shared__ int turn;
    if (threadIdx.x == 0) turn = next();
    __syncthreads();
    return turn;
  }
  // Publishes the sum of a turn; called by one thread.
  __device__ void publish(int turn, int64_t own) const { set(turn, kOwn, own); }
  // Waits for the sum of all earlier turns and returns it; called by one thread.
  __device__ int64_t before(int turn) const {
    uint64_t state;
    do state = look(turn);
    while (state < kOthers);
    return value(state);
  }

  // Adds up the sums of turns [0, n) as blocks publish them; called by one warp; blocks take all of them.
  __device__ void add_up(int n) const {
    constexpr int kEach = 4;  // turns that a lane reads at a time
    const int lane = threadIdx.x % 32;
    int64_t sum = 0;
    for (int done = 0; done < n;) {
      const int begin = done + kEach * lane;
      uint64_t states[kEach];
#pragma unroll
      for (int k = 0; k < kEach; ++k) states[k] = begin + k < n ? look(begin + k) : 0;
      int ready = 0;
      int64_t own = 0;
#pragma unroll
      for (int k = 0; k < kEach; ++k) {
        if (ready < k || states[k] == 0) continue;
        ready = k + 1;
        own += value(states[k]);
      }
      // Turns after the first unpublished one wait for it.
      const unsigned short_of = __ballot_sync(kFullWarp, ready < kEach);
      const int last = short_of ? __ffs(short_of) - 1 : 31;
      if (lane > last) own = 0;
      const int64_t until = sum_of_lanes_until(own, lane);
      int64_t before = sum + until - own;
#pragma unroll
      for (int k = 0; k < kEach; ++k) {
        if (lane > last || k >= ready) break;
        set(begin + k, kOthers, before);
        before += value(states[k]);
      }
      sum += __shfl_sync(kFullWarp, until, 31);
      done += kEach * last + __shfl_sync(kFullWarp, ready, last);
    }
  }
};

}  // namespace blitzgs::cuda
