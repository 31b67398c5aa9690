// SPDX-License-Identifier: Apache-2.0
#include "population/copy_rows.h"

#include <cstring>

#include "common/parallel.h"

namespace blitzgs::cpu {

void copy_rows(const CopyRows& copy, CudaStream) {
  const auto bytes = static_cast<std::size_t>(copy.row_bytes);
  parallel_for(0, copy.n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::byte* out = copy.out + (copy.to ? copy.to[i] : i) * copy.row_bytes;
      if (copy.column) {
        std::memcpy(out, copy.column + (copy.from ? copy.from[i] : i) * copy.row_bytes, bytes);
      } else {
        std::memset(out, 0, bytes);
      }
    }
  });
}

}  // namespace blitzgs::cpu
