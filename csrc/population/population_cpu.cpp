// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <atomic>
#include <cstring>

#include "common/parallel.h"
#include "population/copy_rows.h"
#include "population/find_non_finite.h"
#include "population/sampling.h"
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
  parallel_rows(args.n_rows, 256, [&](std::int64_t row) {
    args.sums[row] = tree_sum_of(args, args.features + row * args.n_features);
  });
}

void copy_rows(const CopyRows& copy, CudaStream) {
  const auto bytes = static_cast<std::size_t>(copy.row_bytes);
  parallel_rows(copy.n, 1 << 12, [&](std::int64_t i) {
    std::byte* out = copy.out + (copy.to ? copy.to[i] : i) * copy.row_bytes;
    if (copy.column) {
      std::memcpy(out, copy.column + (copy.from ? copy.from[i] : i) * copy.row_bytes, bytes);
    } else {
      std::memset(out, 0, bytes);
    }
  });
}

void sampling_keys(const SamplingKeys& args, CudaStream) {
  parallel_rows(args.n, 1 << 12, [&](std::int64_t i) { args.keys[i] = sampling_key(args, i); });
}

void key_histogram(const KeyHistogram& args, CudaStream) {
  std::fill_n(args.counts, std::int64_t{1} << args.width, 0);
  for (std::int64_t i = 0; i < args.n; ++i) {
    const int digit = digit_of(args, *args.prefix, args.keys[i]);
    if (digit >= 0) ++args.counts[digit];
  }
}

}  // namespace blitzgs::cpu
