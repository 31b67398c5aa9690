// SPDX-License-Identifier: Apache-2.0
// Builds a new column of a table from an old one: row i of `out` is row rows[i] of `column` [count] if
// rows[i] < count, and otherwise row rows[i] - count of `fresh`.
//
// Rows are `row_bytes` bytes each. rows int64 [n], in [0, count + number of rows in fresh). fresh null: new
// rows are zeros. Each row of `out` is read and written once.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

struct TakeRows {
  const std::byte* column;
  const std::byte* fresh;
  std::byte* out;
  const std::int64_t* rows;
  std::int64_t n, count, row_bytes;
};

namespace BLITZGS_BACKEND {
void take_rows(const TakeRows&, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
