// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/parallel.h"
#include "render/gather_rows.h"

namespace blitzgs::cpu {

void gather_rows(const GatherRows& gather, Workspace&, CudaStream) {
  parallel_for(0, gather.n, 1 << 10, [&](std::int64_t begin, std::int64_t end) {
    for (int c = 0; c < gather.n_columns; ++c) {
      const GatheredColumn& column = gather.columns[c];
      for (std::int64_t i = begin; i < end; ++i) {
        const std::int64_t row = gather.ids ? gather.ids[i] : i;
        std::copy_n(column.from + row * column.from_stride, column.width, column.to + i * column.stride);
      }
    }
  });
}

}  // namespace blitzgs::cpu
