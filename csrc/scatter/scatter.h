// SPDX-License-Identifier: Apache-2.0
// Rows on their way between ranks. Bit m of masks[p] sends row p to rank m; the rows for one rank are a
// group. All data are 32-bit words: a column of w words a row is int32 [P, w].
//
//   scatter: columns, masks -> one group per rank, each column of a group consecutive; and bases
//            int32 [blocks, M]: where in each group the rows of each block of kScatterBlock rows begin.
//            Within a block rows keep their order; blocks may come in any order, so this and the masks are
//            all that the way back needs.
//   gather:  groups that arrived, one after the other -> columns.
//   sum:     values [S, F], groups in the layout of `scatter` one after the other -> columns [P, w], the sum
//            over the groups of each row in the order of ranks, starting from zero: deterministic.
//
// O(words moved). Rows beyond a group's announced size are dropped, whatever the masks say.
#pragma once
#include <cstdint>

#include "common/stream.h"
#include "math/rank_tiles.h"

namespace blitzgs {

constexpr int kScatterBlock = 256;
constexpr int kMaxRowColumns = 8;

inline std::int64_t scatter_blocks(std::int64_t rows) { return (rows + kScatterBlock - 1) / kScatterBlock; }

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

// Values that came back, and where they belong.
template <class T>
struct ReturnedRows {
  const T* values;
  int width;
  const std::int64_t* masks;
  const std::int32_t* bases;
  std::int64_t count;
  RowGroups groups;
};

namespace cpu {
void scatter(const ScatterRows&, const RowGroups&, const ScatterTargets&, std::int32_t* bases, Workspace&,
             CudaStream);
void gather(const std::int32_t* packed, const RowGroups&, const RowColumns<std::int32_t>&, Workspace&,
            CudaStream);
template <class T>
void sum(const ReturnedRows<T>&, const RowColumns<T>&, Workspace&, CudaStream);
}  // namespace cpu

namespace cuda {
void scatter(const ScatterRows&, const RowGroups&, const ScatterTargets&, std::int32_t* bases, Workspace&,
             CudaStream);
void gather(const std::int32_t* packed, const RowGroups&, const RowColumns<std::int32_t>&, Workspace&,
            CudaStream);
template <class T>
void sum(const ReturnedRows<T>&, const RowColumns<T>&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
