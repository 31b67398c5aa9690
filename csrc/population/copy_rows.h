// SPDX-License-Identifier: Apache-2.0
// Copies rows between columns of a table: row to[i] of `out` becomes row from[i] of `column`.
//
// Rows are `row_bytes` bytes each. from, to int64 [n]; null: i. column null: the rows become zeros. No row of
// `out` may be written twice, or be read. Each row is read and written once.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

struct CopyRows {
  const std::byte* column;
  const std::int64_t* from;
  std::byte* out;
  const std::int64_t* to;
  std::int64_t n, row_bytes;
};

namespace BLITZGS_BACKEND {
void copy_rows(const CopyRows&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
