// SPDX-License-Identifier: Apache-2.0
// Gathers the same rows of several columns in one launch. A row of a column has `width` words of 4 bytes:
//   column.to[i stride + k] = column.from[ids[i] from_stride + k],  0 <= i < n,  0 <= k < width.
// With a stride above the width, several columns are gathered side by side into one; with a from_stride above
// the width, a column is a part of wider rows. ids int32 [n], rows of the columns, not checked; null: 0 to n
// - 1. known: null, or (CUDA) the number of valid ids, see valid_splat_count in common/kernel.h.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

constexpr int kMaxGatheredColumns = 8;

struct GatheredColumn {
  const std::uint32_t* from;
  std::uint32_t* to;
  std::int64_t from_stride, stride;
  std::uint32_t width;
};

struct GatherRows {
  const std::int32_t* ids;
  std::int64_t n;
  const std::int64_t* known;
  int n_columns;
  GatheredColumn columns[kMaxGatheredColumns];
};

namespace BLITZGS_BACKEND {
void gather_rows(const GatherRows&, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
