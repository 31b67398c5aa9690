// SPDX-License-Identifier: Apache-2.0
#include <atomic>

#include "common/parallel.h"
#include "population/find_non_finite.h"
#include "population/tree_sums.h"

namespace blitzgs::cpu {

void clear_flag(std::int32_t* bad, CudaStream) { *bad = 0; }

template <class T>
void check_columns(const CheckedColumns<T>& checked, CudaStream) {
  std::atomic<bool> found{false};
  for (int c = 0; c < checked.n; ++c) {
    const auto& column = checked.columns[c];
    parallel_for(0, column.length, 1 << 16, [&](std::int64_t begin, std::int64_t end) {
      bool bad = false;  // without an early end, so that the compiler can vectorise the loop
      for (std::int64_t i = begin; i < end; ++i) bad |= is_bad(column.values[i], column.zero_is_bad);
      if (bad) found.store(true, std::memory_order_relaxed);
    });
  }
  if (found) *checked.bad = 1;
}

template void check_columns<float>(const CheckedColumns<float>&, CudaStream);
template void check_columns<double>(const CheckedColumns<double>&, CudaStream);

void tree_sums(const TreeSumsArgs& args, CudaStream) {
  parallel_for(0, args.n_rows, 256, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t row = begin; row < end; ++row) {
      args.sums[row] = tree_sum_of(args, args.features + row * args.n_features);
    }
  });
}

}  // namespace blitzgs::cpu
