// SPDX-License-Identifier: Apache-2.0
// One block's rows to the ranks that need them. Runs of consecutive words leave for each rank and column, in
// whole memory transactions but for their ends, so that a target across a link is written in few packets.
// Only the place of a run is agreed on, with one atomic per block and rank.
#pragma once
#include <type_traits>

#include "scatter/scatter.h"

namespace blitzgs::cuda {

inline constexpr int kScatterWarps = kScatterBlock / 32;
inline constexpr int kFewRanks = 8;  // what most hosts have: needs less shared memory than kMaxRanks

// Calls f(integral constant: an upper bound of the ranks).
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
  std::uint8_t list[RANKS][kScatterBlock];  // threads whose rows go to each rank, ascending
  int in_warp[RANKS][kScatterWarps];
  int count[RANKS], base[RANKS];
};

// What all blocks share: how far each group is filled (zeroed before), and what `scatter` returns.
struct ScatterState {
  std::int32_t *filled, *bases;
};

// Rows for rank m in the warps before this one, and in this one before this thread.
__device__ __forceinline__ int place_in_block(const int* in_warp, unsigned going) {
  int before = __popc(going & ((1u << threadIdx.x % 32) - 1u));
  for (int warp = 0; warp < static_cast<int>(threadIdx.x) / 32; ++warp) before += in_warp[warp];
  return before;
}

// Counts the rows of each warp for each rank; the block has to synchronise before they are read.
__device__ __forceinline__ void count_by_warp(int (*in_warp)[kScatterWarps], std::int64_t mask, int n_ranks) {
  for (int m = 0; m < n_ranks; ++m) {
    const unsigned going = __ballot_sync(0xffffffffu, (mask >> m) & 1);
    if (threadIdx.x % 32 == 0) in_warp[m][threadIdx.x / 32] = __popc(going);
  }
}

// Words by which a warp has to start early for its stores to be whole 128-byte transactions.
__device__ __forceinline__ int words_past_line(const void* address) {
  return static_cast<int>(reinterpret_cast<std::uintptr_t>(address) / 4 % 32);
}

template <int WIDTH>
__device__ __forceinline__ void copy_run(const std::int32_t* from, const std::uint8_t* list, int n,
                                         int any_width, std::int32_t* to) {
  const int width = WIDTH > 0 ? WIDTH : any_width;
  for (int i = static_cast<int>(threadIdx.x % 32) - words_past_line(to); i < n * width; i += 32) {
    if (i < 0) continue;
    const int row = i / width;
    to[i] = from[list[row] * width + (i - row * width)];
  }
}

// All kScatterBlock threads of the block call this, each with the mask of its row (0 beyond the last row).
// The columns of the block's rows must be visible to the whole block.
template <int RANKS>
__device__ void scatter_block(ScatterShared<RANKS>& shared, const RowColumns<const std::int32_t>& columns,
                              std::int64_t mask, const RowGroups& groups, const ScatterTargets& targets,
                              const ScatterState& state) {
  const int n_ranks = groups.count;
  count_by_warp(shared.in_warp, mask, n_ranks);
  __syncthreads();
  if (static_cast<int>(threadIdx.x) < n_ranks) {
    const int m = threadIdx.x;
    int count = 0;
    for (int warp = 0; warp < kScatterWarps; ++warp) count += shared.in_warp[m][warp];
    const int base = count ? atomicAdd(state.filled + m, count) : 0;
    state.bases[blockIdx.x * static_cast<std::int64_t>(n_ranks) + m] = base;
    const std::int64_t room = groups.size[m] - base;
    shared.base[m] = base;
    shared.count[m] = room >= count ? count : room > 0 ? static_cast<int>(room) : 0;
  }
  for (int m = 0; m < n_ranks; ++m) {
    const bool goes = (mask >> m) & 1;
    const unsigned going = __ballot_sync(0xffffffffu, goes);
    if (goes) {
      shared.list[m][place_in_block(shared.in_warp[m], going)] = static_cast<std::uint8_t>(threadIdx.x);
    }
  }
  __syncthreads();
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kScatterBlock);
  for (int run = threadIdx.x / 32; run < n_ranks * columns.count; run += kScatterWarps) {
    const int m = run / columns.count, c = run - m * columns.count;
    const int width = columns.begin[c + 1] - columns.begin[c];
    const std::int32_t* from = columns.data[c] + first * width;
    std::int32_t* to = targets.words[m][c] + static_cast<std::int64_t>(shared.base[m]) * width;
    const std::uint8_t* list = shared.list[m];
    const int n = shared.count[m];
    switch (width) {
      case 1:
        copy_run<1>(from, list, n, width, to);
        break;
      case 2:
        copy_run<2>(from, list, n, width, to);
        break;
      case 3:
        copy_run<3>(from, list, n, width, to);
        break;
      default:
        copy_run<0>(from, list, n, width, to);
    }
  }
}

}  // namespace blitzgs::cuda
