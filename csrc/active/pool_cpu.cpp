// SPDX-License-Identifier: Apache-2.0
#include "active/pool.h"

#include <cstring>

#include "common/parallel.h"

namespace blitzgs::cpu {

void seen_blocks(const SeenBlocks& args, Workspace&, CudaStream) {
  Frustum planes[kMaxViews];
  for (int view = 0; view < args.views; ++view) planes[view] = frustum_of(args, view);
  parallel_for(0, args.n, 1024, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      args.seen[block] = views_that_see(args, planes, block);
    }
  });
}

void swap_blocks(const SwapBlocks& swap, Workspace&, CudaStream) {
  parallel_for(0, swap.n, 4, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      for (int c = 0; c < swap.n_columns; ++c) {
        const SwapColumn& column = swap.columns[c];
        const auto bytes = static_cast<std::size_t>(column.bytes);
        std::byte* slot = column.pool + swap.slots[i] * column.bytes;
        if (swap.leaving[i] >= 0 && column.is_written) {
          std::memcpy(column.table + swap.leaving[i] * column.bytes, slot, bytes);
        }
        if (swap.coming[i] >= 0) std::memcpy(slot, column.table + swap.coming[i] * column.bytes, bytes);
      }
    }
  });
}

}  // namespace blitzgs::cpu
