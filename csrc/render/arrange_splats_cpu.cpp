// SPDX-License-Identifier: Apache-2.0
#include "render/arrange_splats.h"

#include <algorithm>

#include "common/parallel.h"

namespace blitzgs::cpu {

namespace {

constexpr std::int64_t kGrain = 1 << 12;

}  // namespace

void fill_entries(const EmptyEntries& fill, CudaStream) {
  const std::int64_t words = fill.column.words;
  parallel_for(0, fill.entries, kGrain, [&](std::int64_t begin, std::int64_t end) {
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
  parallel_for(0, moves.n, kGrain, [&](std::int64_t begin, std::int64_t end) {
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
