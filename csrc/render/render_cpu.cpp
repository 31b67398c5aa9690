// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "render/render.h"

namespace blitzgs::cpu {

void gather_rows(const GatherRows& gather, CudaStream) {
  parallel_for(0, gather.n, 1 << 10, [&](int64_t begin, int64_t end) {
    for (int c = 0; c < gather.n_columns; ++c) {
      const GatheredColumn& column = gather.columns[c];
      for (int64_t i = begin; i < end; ++i) {
        const int64_t row = gather.ids[i];
        std::copy_n(column.from + row * column.width, column.width, column.to + i * column.stride);
      }
    }
  });
}

void zero_words(uint32_t* words, int64_t n, CudaStream) { parallel_zero(words, n); }

}  // namespace blitzgs::cpu
