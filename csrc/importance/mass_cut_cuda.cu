// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "importance/mass_cut.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 512;
constexpr int kWarps = kThreads / 32;
// The number of segments whose first digits a block sums in shared memory, 8 KiB each.
constexpr int kSegmentsAtOnce = 8;
// The first round whose scan reads the list, and the first of those that one kernel takes together. Before
// the latter, a threshold has the 36 bits after its first digit; only weights from 2^41 units on, 2^9 whole
// pixels, have more.
constexpr int kListedRounds = 2, kLaterRounds = 4;

// A 64-bit sum as two words, because in shared memory an atomic addition of 64 bits is a loop.
struct WideSum {
  uint32_t low, high;

  __device__ void add(int64_t amount) {
    const auto part = uint32_t(amount);
    const uint32_t before = atomicAdd(&low, part);
    const uint32_t carry = before + part < before;
    const auto rest = uint32_t(amount >> 32) + carry;
    if (rest > 0) atomicAdd(&high, rest);
  }
  __device__ int64_t value() const { return int64_t(high) << 32 | low; }
};

// The scan of round 0: sums the weights of all items by their first digit into sums [S, kDigits]. One thread
// per item in a grid-stride loop. The blocks of grid row y handle the segments from y * kSegmentsAtOnce on.
__global__ void __launch_bounds__(kThreads) first_scan_kernel(const MassCutArgs args) {
  extern __shared__ __align__(16) unsigned char shared_bytes[];
  auto* const digits = reinterpret_cast<WideSum*>(shared_bytes);
  const int first_segment = blockIdx.y * kSegmentsAtOnce;
  const int n_segments = min(int(args.n_segments) - first_segment, kSegmentsAtOnce);
  for (int i = threadIdx.x; i < n_segments * kFirstDigits; i += kThreads) digits[i] = {0, 0};
  wait_for_earlier_kernels();
  __syncthreads();
  if (blockIdx.x == 0 && blockIdx.y == 0 && threadIdx.x == 0) args.listed[0] = 0;
  const int64_t stride = int64_t(gridDim.x) * kThreads;
  for (int64_t item = blockIdx.x * kThreads + threadIdx.x; item < args.n_items; item += stride) {
    const int segment = args.segments[item] - first_segment;
    const int64_t weight = args.weights[item];
    if (segment < 0 || segment >= n_segments || weight == 0) continue;
    digits[segment * kFirstDigits + first_digit(weight)].add(weight);
  }
  __syncthreads();
  for (int i = threadIdx.x; i < n_segments * kFirstDigits; i += kThreads) {
    const int64_t sum = digits[i].value();
    const int segment = first_segment + i / kFirstDigits;
    if (sum != 0) atomic_add(args.sums + int64_t{segment} * kDigits + i % kFirstDigits, sum);
  }
}

__device__ void add_term(const MassCutArgs& args, int64_t segment, const ScanTerm& term) {
  if (term.adds) atomic_add(args.sums + segment * kDigits + term.digit, term.amount);
}

// The scan of round 1: lists the items with the first digit of their segment's threshold, and sums their
// weights by the next digit. One thread per item in a grid-stride loop.
__global__ void __launch_bounds__(kThreads) second_scan_kernel(const MassCutArgs args) {
  wait_for_earlier_kernels();
  const int64_t stride = int64_t(gridDim.x) * kThreads;
  const int lane = threadIdx.x % 32;
  for (int64_t begin = blockIdx.x * kThreads + threadIdx.x - lane; begin < args.n_items; begin += stride) {
    const int64_t item = begin + lane;
    const bool lists = item < args.n_items && is_listed(args, item);
    const unsigned lanes = __ballot_sync(kFullWarp, lists);
    if (lanes == 0) continue;
    int place = lane == 0 ? atomicAdd(args.listed, __popc(lanes)) : 0;
    place = __shfl_sync(kFullWarp, place, 0) + __popc(lanes & ((1u << lane) - 1));
    if (!lists) continue;
    args.listed[1 + place] = int32_t(item);
    add_term(args, args.segments[item], scan_term(args, 1, item));
  }
}

// The scan of later rounds: one thread per listed item in a grid-stride loop.
__global__ void __launch_bounds__(kThreads) scan_kernel(const MassCutArgs args, int round) {
  wait_for_earlier_kernels();
  const int64_t count = args.listed[0], stride = int64_t(gridDim.x) * kThreads;
  for (int64_t i = blockIdx.x * kThreads + threadIdx.x; i < count; i += stride) {
    const int64_t item = args.listed[1 + i];
    add_term(args, args.segments[item], scan_term(args, round, item));
  }
}

// until: the sum over a block's threads up to and including this one. total: over all threads.
struct BlockScan {
  int64_t until, total;
};

__device__ BlockScan scan_block(int64_t value) {
  __shared__ int64_t warps[kWarps];
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  int64_t until = sum_of_lanes_until(value, lane), total = 0;
  if (lane == 31) warps[warp] = until;
  __syncthreads();
  for (int i = 0; i < kWarps; ++i) {
    if (i < warp) until += warps[i];
    total += warps[i];
  }
  return {until, total};
}

// The descent of a round in the segment of this block: finds the next digit of the threshold and sets the
// sums to zero. Each thread sums over kEach neighbouring digits, thread 0 over the largest ones.
__device__ void descend(const MassCutArgs& args, int round) {
  constexpr int kEach = kDigits / kThreads;
  SegmentSearch& both = args.searches[blockIdx.x];
  const bool first = round % kRounds == 0;
  MassSearch search = round >= kRounds ? both.id : both.weight;
  // If there is no digit to find, the scan has added nothing either, so the sums are zero already.
  if (round > 0 && round != kRounds - 1 && !descends(search, first)) return;
  int64_t* const sums = args.sums + int64_t{blockIdx.x} * kDigits;
  const int top = kDigits - 1 - int(threadIdx.x) * kEach;
  int64_t mine[kEach], sum = 0;
#pragma unroll
  for (int i = 0; i < kEach; ++i) {
    mine[i] = sums[top - i];
    sums[top - i] = 0;
    sum += mine[i];
  }
  const BlockScan scan = scan_block(sum);
  if (round == 0) search = {kAboveAllWeights, 0, share_of(scan.total, args.numerator, args.denominator), 0};
  int64_t above = scan.until - sum;
  const bool is_below = above < search.missing && search.missing <= scan.until;
  const bool writes = descends(search, first) ? is_below : threadIdx.x == 0;
  __syncthreads();  // all threads have read the search before one of them writes it
  if (!writes) return;
  if (descends(search, first)) {
    int i = 0;
    while (above + mine[i] < search.missing) above += mine[i++];
    take_digit(search, first, top - i, above, mine[i]);
  }
  (round >= kRounds ? both.id : both.weight) = search;
  if (round == kRounds - 1) both.id = search_of_ids(search);
}

__global__ void __launch_bounds__(kThreads) descent_kernel(const MassCutArgs args, int round) {
  wait_for_earlier_kernels();
  descend(args, round);
}

// All rounds from kLaterRounds on, one block per segment. As a rule they find no digit, so this takes less
// time than two launches for each of them.
__global__ void __launch_bounds__(kThreads) later_rounds_kernel(const MassCutArgs args) {
  constexpr int kEach = 4;  // items of a thread that are read at the same time
  wait_for_earlier_kernels();
  const int segment = int(blockIdx.x);
  const int64_t count = args.listed[0];
  for (int round = kLaterRounds; round < 2 * kRounds; ++round) {
    const bool finds = finds_digit(args.searches[segment], round);
    if (!finds && round != kRounds - 1) continue;
    for (int64_t begin = threadIdx.x; finds && begin < count; begin += kEach * kThreads) {
      ScanTerm terms[kEach];
#pragma unroll
      for (int i = 0; i < kEach; ++i) {
        terms[i] = {false, 0, 0};
        const int64_t at = begin + i * kThreads;
        if (at >= count) continue;
        const int64_t item = args.listed[1 + at];
        if (args.segments[item] == segment) terms[i] = scan_term(args, round, item);
      }
#pragma unroll
      for (const ScanTerm& term : terms) add_term(args, segment, term);
    }
    __syncthreads();
    descend(args, round);
    __syncthreads();
  }
}

__global__ void __launch_bounds__(kThreads) choice_kernel(const MassCutArgs args) {
  wait_for_earlier_kernels();
  const int64_t item = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (item < args.n_items) args.chosen[item] = is_chosen(args, item);
}

void scan(const MassCutArgs& args, int round, CudaStream stream) {
  const unsigned all = std::max(1u, blocks_for(args.n_items, kThreads));
  const unsigned resident = unsigned(4 * multiprocessors());
  if (round >= kListedRounds) {
    launch_early("mass_cut", scan_kernel, {std::min(all, resident / 4), kThreads, stream}, args, round);
  } else if (round == 1) {
    launch_early("mass_cut", second_scan_kernel, {std::min(all, resident), kThreads, stream}, args);
  } else {
    const auto groups = unsigned((args.n_segments + kSegmentsAtOnce - 1) / kSegmentsAtOnce);
    constexpr size_t kBytes = kFirstDigits * sizeof(WideSum);  // shared memory of a segment
    const size_t bytes = std::min<int64_t>(args.n_segments, kSegmentsAtOnce) * kBytes;
    // Every call sets the same attribute, the most that any call needs, because another thread may launch the
    // kernel between this call and the launch.
    check(cudaFuncSetAttribute(first_scan_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize,
                               int(kSegmentsAtOnce * kBytes)),
          "mass_cut");
    launch_early("mass_cut", first_scan_kernel,
                 {dim3(std::min(all, resident / 2), groups), kThreads, stream, bytes}, args);
  }
}

}  // namespace

void mass_cut(const MassCutArgs& args, int first_step, int last_step, CudaStream stream) {
  const auto segments = unsigned(args.n_segments);
  for (int step = first_step; step < std::min(last_step, kChoiceStep); ++step) {
    if (step == 2 * kLaterRounds && last_step >= kChoiceStep) {
      launch_early("mass_cut", later_rounds_kernel, {segments, kThreads, stream}, args);
      break;
    }
    if (step % 2 == 0) {
      scan(args, step / 2, stream);
    } else {
      launch_early("mass_cut", descent_kernel, {segments, kThreads, stream}, args, step / 2);
    }
  }
  if (last_step == kSteps && args.n_items > 0) {
    launch_early("mass_cut", choice_kernel, {blocks_for(args.n_items, kThreads), kThreads, stream}, args);
  }
}

}  // namespace blitzgs::cuda
