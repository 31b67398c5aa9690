// SPDX-License-Identifier: Apache-2.0
#include <cstring>

#include "common/parallel.h"
#include "population/take_rows.h"

namespace blitzgs::cpu {

void take_rows(const TakeRows& take, Workspace&, CudaStream) {
  const auto bytes = static_cast<std::size_t>(take.row_bytes);
  parallel_for(0, take.n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t row = take.rows[i];
      std::byte* out = take.out + i * take.row_bytes;
      if (row < take.count) {
        std::memcpy(out, take.column + row * take.row_bytes, bytes);
      } else if (take.fresh) {
        std::memcpy(out, take.fresh + (row - take.count) * take.row_bytes, bytes);
      } else {
        std::memset(out, 0, bytes);
      }
    }
  });
}

}  // namespace blitzgs::cpu
