// SPDX-License-Identifier: Apache-2.0
// Rows on their way between ranks. Bit m of masks[p] sends row p to rank m; the rows for one rank are a
// group. All data are 32-bit words: a column of w words a row is int32 [P, w].
//
//   scatter: columns, masks -> one group per rank, each column of a group consecutive; and places [runs, M]:
//            where in each group the rows of each run of kPlaceRows rows are. Within a block of kScatterBlock
//            rows they keep their order; blocks may come in any order, so this is all that the way back
//            needs.
//   gather:  groups that arrived, one after the other -> columns.
//   sum:     values [S, F], groups in the layout of `scatter` one after the other -> columns [P, w], the sum
//            over the groups of each row in the order of ranks, starting from zero: deterministic.
//
// O(words moved). Rows beyond a group's announced size are dropped, whatever the masks say.
#pragma once
#include <cstdint>

#include "common/host_device.h"
#include "common/stream.h"
#include "math/rank_tiles.h"

namespace blitzgs {

constexpr int kScatterBlock = 256;
constexpr int kPlaceRows = 32;
constexpr int kMaxRowColumns = 8;

inline std::int64_t scatter_blocks(std::int64_t rows) { return (rows + kScatterBlock - 1) / kScatterBlock; }

inline std::int64_t place_runs(std::int64_t rows) { return (rows + kPlaceRows - 1) / kPlaceRows; }

BLITZGS_HD int count_bits(std::uint32_t bits) {
#ifdef __CUDA_ARCH__
  return __popc(bits);
#else
  return __builtin_popcount(bits);
#endif
}

// bits != 0.
BLITZGS_HD int lowest_bit(std::uint64_t bits) {
#ifdef __CUDA_ARCH__
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}

// The rows of a run that went to one rank: where the first of them is among the rank's, and which they are.
// The ops pass it as an int64.
struct alignas(8) RowPlace {
  std::int32_t first;
  std::uint32_t bits;

  // row: of the run, in [0, kPlaceRows).
  BLITZGS_HD bool has(std::uint32_t row) const { return (bits >> row) & 1u; }
  BLITZGS_HD std::int64_t of(std::uint32_t row) const {
    return first + count_bits(bits & ((1u << row) - 1u));
  }
};

// Columns of one table, and where each begins in a row of all of them; the last begin is the row's length.
template <class Word>
struct RowColumns {
  Word* data[kMaxRowColumns];
  int begin[kMaxRowColumns + 1];
  int count;
};

// Rows of each group and the rows before it; M groups.
struct RowGroups {
  std::int64_t size[kMaxRanks], start[kMaxRanks];
  int count;
};

// Where each column of each rank's group begins.
struct ScatterTargets {
  std::int32_t* words[kMaxRanks][kMaxRowColumns];
};

// The rows to scatter.
struct ScatterRows {
  RowColumns<const std::int32_t> columns;
  const std::int64_t* masks;
  std::int64_t count;
};

// Values of rows, `width` apart, that came back from each rank that a row went to.
template <class T>
struct RowValues {
  const T* values;
  int width;
  std::int64_t count;
  const RowPlace* places;
  RowGroups groups;

  // Calls f(pointer to a row's values), for each rank in order.
  template <class F>
  BLITZGS_HD void for_each(std::uint64_t row, const F& f) const {
    const RowPlace* run = places + row / kPlaceRows * groups.count;
    const auto in_run = static_cast<std::uint32_t>(row % kPlaceRows);
    std::uint64_t ranks = 0;
#ifdef __CUDA_ARCH__
#pragma unroll 4  // as many loads at once; the compiler's own choice is 16
#endif
    for (int m = 0; m < groups.count; ++m) ranks |= std::uint64_t{run[m].has(in_run)} << m;
    // Most rows went to a single rank: this way the threads of a warp load their first at once.
    for (; ranks != 0; ranks &= ranks - 1) {
      const int m = lowest_bit(ranks);
      const std::int64_t at = run[m].of(in_run);
      if (at < groups.size[m]) f(values + (groups.start[m] + at) * width);
    }
  }
};

namespace cpu {
void scatter(const ScatterRows&, const RowGroups&, const ScatterTargets&, RowPlace* places, Workspace&,
             CudaStream);
void gather(const std::int32_t* packed, const RowGroups&, const RowColumns<std::int32_t>&, Workspace&,
            CudaStream);
template <class T>
void sum(const RowValues<T>&, const RowColumns<T>&, Workspace&, CudaStream);
}  // namespace cpu

namespace cuda {
void scatter(const ScatterRows&, const RowGroups&, const ScatterTargets&, RowPlace* places, Workspace&,
             CudaStream);
void gather(const std::int32_t* packed, const RowGroups&, const RowColumns<std::int32_t>&, Workspace&,
            CudaStream);
template <class T>
void sum(const RowValues<T>&, const RowColumns<T>&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
