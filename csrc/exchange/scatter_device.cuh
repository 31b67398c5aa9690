// SPDX-License-Identifier: Apache-2.0
// The scatter of one block of splats to the ranks that need them. For each rank and column a warp writes one
// run of consecutive words, in whole memory transactions except at its ends, so that a write across a link
// takes few packets. Blocks agree on the positions of their runs with one atomic addition per block and rank.
#pragma once
#include <type_traits>

#include "common/cuda.cuh"
#include "exchange/scatter.h"

namespace blitzgs::cuda {

inline constexpr int kScatterWarps = kScatterBlock / 32;
static_assert(kPlaceSplats == 32, "a warp's splats are a run");
inline constexpr int kFewRanks = 8;  // enough for most hosts, with less shared memory than kMaxRanks

// Calls f(integral constant: an upper bound on the number of ranks).
template <class F>
void dispatch_ranks(int n_ranks, const F& f) {
  if (n_ranks <= kFewRanks) {
    f(std::integral_constant<int, kFewRanks>{});
  } else {
    f(std::integral_constant<int, kMaxRanks>{});
  }
}

template <int RANKS>
struct ScatterShared {
  std::uint8_t list[RANKS][kScatterBlock];  // the block's splats that go to each rank, ascending
  int before[RANKS][kScatterWarps];
  int count[RANKS], base[RANKS];
  std::int64_t target[RANKS];  // the position of the block's first splat in the rank's columns
};

// The number of splats that go to each rank.
struct ScatterSizes {
  const std::int64_t* sizes;
  int n_ranks;
};

// The state that all blocks share.
struct ScatterState {
  std::int64_t* filled;  // the number of positions of each group that blocks have taken; zero at the start
  SplatPlace* places;    // the output of scatter

  // Takes `count` positions of group m and returns the first.
  __device__ std::int64_t take(int m, int count) const {
    if (count == 0) return 0;
    return static_cast<std::int64_t>(
        atomicAdd(reinterpret_cast<unsigned long long*>(filled) + m, static_cast<unsigned long long>(count)));
  }
};

// Counts the splats of a warp that go to each rank. mask: that of this lane's splat.
__device__ __forceinline__ void count_by_warp(int (*counts)[kScatterWarps], int slot, std::int64_t mask,
                                              int n_ranks) {
  for (int m = 0; m < n_ranks; ++m) {
    const unsigned going = __ballot_sync(kFullWarp, (mask >> m) & 1);
    if (slot % 32 == 0) counts[m][slot / 32] = __popc(going);
  }
}

// Replaces one rank's counts by the sums of the counts before each warp, and returns the total.
__device__ __forceinline__ int scan_warps(int* counts) {
  int sum = 0;
#pragma unroll
  for (int warp = 0; warp < kScatterWarps; ++warp) {
    const int count = counts[warp];
    counts[warp] = sum;
    sum += count;
  }
  return sum;
}

// The number of the block's splats for one rank before splat `slot`. going: the splats of its warp that go to
// the rank, as bits.
__device__ __forceinline__ int place_in_block(const int* before, int slot, unsigned going) {
  return before[slot / 32] + __popc(going & ((1u << slot % 32) - 1u));
}

// The number of words between the last multiple of 128 bytes and an address. A warp that starts so many words
// before the address stores whole 128-byte transactions.
__device__ __forceinline__ int words_past_line(const void* address) {
  return static_cast<int>(reinterpret_cast<std::uintptr_t>(address) / 4 % 32);
}

// A warp copies the `n` listed splats of one column to consecutive memory. Each lane has kAhead loads in
// flight, because the values come from the second-level cache at best.
template <int WIDTH>
__device__ __forceinline__ void copy_run(const std::int32_t* from, const std::uint8_t* list, int n,
                                         int any_width, std::int32_t* to) {
  constexpr int kAhead = 4;
  const int width = WIDTH > 0 ? WIDTH : any_width, words = n * width;
  for (int first = static_cast<int>(threadIdx.x % 32) - words_past_line(to); first < words;
       first += 32 * kAhead) {
    std::int32_t values[kAhead];
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      const int i = first + 32 * k, splat = i / width;
      if (i >= 0 && i < words) values[k] = from[list[splat] * width + (i - splat * width)];
    }
#pragma unroll
    for (int k = 0; k < kAhead; ++k) {
      const int i = first + 32 * k;
      if (i >= 0 && i < words) to[i] = values[k];
    }
  }
}

__device__ __forceinline__ void copy_run(const std::int32_t* from, const std::uint8_t* list, int n, int width,
                                         std::int32_t* to) {
  switch (width) {
    case 1:
      return copy_run<1>(from, list, n, width, to);
    case 2:
      return copy_run<2>(from, list, n, width, to);
    case 3:
      return copy_run<3>(from, list, n, width, to);
    default:
      return copy_run<0>(from, list, n, width, to);
  }
}

// Scatters the kScatterBlock splats from kScatterBlock * blockIdx.x on, of n_splats (splats.count is not
// read). All THREADS threads of the block call this.
template <int THREADS, int RANKS>
__device__ void scatter_block(ScatterShared<RANKS>& shared, const ScatterSplats& splats,
                              std::int64_t n_splats, const ScatterSizes& groups,
                              const ScatterTargets& targets, const ScatterState& state) {
  constexpr int kRounds = kScatterBlock / THREADS;
  const int n_ranks = groups.n_ranks;
  const SplatColumns<const std::int32_t>& columns = splats.columns;
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kScatterBlock);
  std::int64_t masks[kRounds];
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    const int slot = round * THREADS + static_cast<int>(threadIdx.x);
    masks[round] = first + slot < n_splats ? splats.masks[first + slot] : 0;
    count_by_warp(shared.before, slot, masks[round], n_ranks);
  }
  __syncthreads();
  if (static_cast<int>(threadIdx.x) < n_ranks) {
    const int m = threadIdx.x;
    const int count = scan_warps(shared.before[m]);
    const std::int64_t base = state.take(m, count);
    const std::int64_t places_left = groups.sizes[m] - base;
    shared.base[m] = static_cast<int>(base);
    shared.target[m] = base;
    shared.count[m] = places_left >= count ? count : places_left > 0 ? static_cast<int>(places_left) : 0;
  }
  __syncthreads();
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    const int slot = round * THREADS + static_cast<int>(threadIdx.x);
    for (int m = 0; m < n_ranks; ++m) {
      const bool goes = (masks[round] >> m) & 1;
      const unsigned going = __ballot_sync(kFullWarp, goes);
      if (goes)
        shared.list[m][place_in_block(shared.before[m], slot, going)] = static_cast<std::uint8_t>(slot);
      if (slot % 32 == 0 && first + slot < n_splats) {
        state.places[(first + slot) / kPlaceSplats * n_ranks + m] = {
            shared.base[m] + shared.before[m][slot / 32], going};
      }
    }
  }
  __syncthreads();
  for (int run = threadIdx.x / 32; run < n_ranks * columns.count; run += THREADS / 32) {
    const int m = run / columns.count, c = run - m * columns.count;
    const int width = columns.begin[c + 1] - columns.begin[c];
    const std::int32_t* from = columns.data[c] + first * width;
    std::int32_t* to = targets.words[m][c] + shared.target[m] * width;
    const std::uint8_t* list = shared.list[m];
    const int n = shared.count[m];
    copy_run(from, list, n, width, to);
  }
}

}  // namespace blitzgs::cuda
