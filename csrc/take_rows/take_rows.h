// SPDX-License-Identifier: Apache-2.0
// Makes a column of a table anew: row i becomes the old row rows[i], or the new row rows[i] - count.
//
// Rows are bytes, `row_bytes` each; rows int64 [n], in [0, count + number of new rows). fresh: the new rows;
// null: zeros. Reads and writes every row once.
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

namespace cpu {
void take_rows(const TakeRows&, Workspace&, CudaStream);
}
namespace cuda {
void take_rows(const TakeRows&, Workspace&, CudaStream);
}

}  // namespace blitzgs
