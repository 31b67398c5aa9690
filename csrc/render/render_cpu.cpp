// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/parallel.h"
#include "render/render.h"

namespace blitzgs::cpu {

void gather_rows(const GatherRows& gather, CudaStream) {
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

void number_rows(const NumberedRows& numbered, const ProjectCapacity& capacity, CudaStream) {
  for (std::int64_t u = 0; u < capacity.sizes.visible; ++u) {
    number_row(numbered, static_cast<std::int32_t>(u));
  }
}

void fill_entries(const EmptyEntries& fill, CudaStream) {
  const std::int64_t words = fill.column.words;
  parallel_for(0, fill.entries, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    if (!fill.under) {
      std::fill(fill.column.to + begin * words, fill.column.to + end * words, 0u);
      return;
    }
    for (std::int64_t i = begin; i < end; ++i) {
      std::copy_n(fill.under + fill.source(i) * words, words, fill.column.to + i * words);
    }
  });
}

void arrange_splats(const ArrangeSplats& moves, bool back, CudaStream) {
  parallel_for(0, moves.n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (int c = 0; c < moves.n_columns; ++c) {
      const ArrangedColumn& column = moves.columns[c];
      for (std::int64_t i = begin; i < end; ++i) {
        const std::int64_t from = back ? moves.entry(i) : moves.splat(i);
        const std::int64_t to = back ? moves.splat(i) : moves.entry(i);
        std::copy_n(column.from + from * column.stride, column.words, column.to + to * column.words);
      }
    }
  });
}

}  // namespace blitzgs::cpu
