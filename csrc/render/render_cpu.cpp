// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "render/render.h"

namespace blitzgs::cpu {

void gather_rows(const GatherRows& gather, CudaStream) {
  parallel_for(0, gather.n, 1 << 10, [&](std::int64_t begin, std::int64_t end) {
    for (int c = 0; c < gather.n_columns; ++c) {
      const GatheredColumn& column = gather.columns[c];
      for (std::int64_t i = begin; i < end; ++i) {
        const std::int64_t row = gather.ids[i];
        std::copy_n(column.from + row * column.width, column.width, column.to + i * column.stride);
      }
    }
  });
}

void zero_words(std::uint32_t* words, std::int64_t n, CudaStream) { parallel_zero(words, n); }

}  // namespace blitzgs::cpu
