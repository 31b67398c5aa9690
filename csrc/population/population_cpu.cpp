// SPDX-License-Identifier: Apache-2.0
#include <utility>

#include "population/columns.h"
#include "population/density.h"
#include "population/knn.h"

namespace blitzgs::cpu {

void clear_flag(int32_t* bad, CudaStream) { *bad = 0; }

template <class T> void check_columns(const CheckedColumns<T>& checked, CudaStream) {
  std::atomic<bool> found{false};
  for (int c = 0; c < checked.n; ++c) {
    const auto& column = checked.columns[c];
    parallel_for(0, column.length, 1 << 16, [&](int64_t begin, int64_t end) {
      bool bad = false;  // without an early end, so that the compiler can vectorise the loop
      for (int64_t i = begin; i < end; ++i) bad |= is_bad(column.values[i], column.zero_is_bad);
      if (bad) found.store(true, std::memory_order_relaxed);
    });
  }
  if (found) *checked.bad = 1;
}

BLITZGS_FOR_BOTH_DTYPES(check_columns);

void tree_sums(const TreeSumsArgs& args, CudaStream) {
  parallel_rows(args.n_rows, 256, [&](int64_t row) {
    args.sums[row] = tree_sum_of(args, args.features + row * args.n_features);
  });
}

void copy_rows(const CopyRows& copy, CudaStream) {
  const auto bytes = size_t(copy.row_bytes);
  parallel_rows(copy.n, 1 << 12, [&](int64_t i) {
    std::byte* out = copy.out + (copy.to ? copy.to[i] : i) * copy.row_bytes;
    if (copy.column) {
      std::memcpy(out, copy.column + (copy.from ? copy.from[i] : i) * copy.row_bytes, bytes);
    } else {
      std::memset(out, 0, bytes);
    }
  });
}

void key_histogram(const KeyHistogram& args, CudaStream) {
  std::fill_n(args.counts, int64_t{1} << args.width, 0);
  for (int64_t i = 0; i < args.n; ++i) {
    const int digit = digit_of(args, *args.prefix, args.keys[i]);
    if (digit >= 0) ++args.counts[digit];
  }
}

void find_digit(const FindDigit& args, CudaStream) {
  const int64_t last = (int64_t{1} << args.width) - 1;
  int64_t digit = 0, before = 0;
  while (digit < last && before + args.counts[digit] < args.search[1]) before += args.counts[digit++];
  take_digit(args, digit, before);
}

template <class T>
void knn_distances(const T* points, int32_t n, int k, T* distances, Workspace& workspace, CudaStream) {
  std::fill_n(distances, int64_t{n} * k, std::numeric_limits<T>::infinity());
  if (n == 0) return;
  using Entry = std::pair<uint64_t, int32_t>;
  Entry* entries = workspace.allocate<Entry>(n);
  const MortonFrame frame = morton_frame_of(points, n);
  parallel_rows(n, 1 << 14,
                [&](int64_t i) { entries[i] = {morton_code(points + 3 * i, frame), int32_t(i)}; });
  std::sort(entries, entries + n);

  KnnTree<T> tree{};
  const Entry* last =
      std::lower_bound(entries, entries + n, Entry{~uint64_t{0}, std::numeric_limits<int32_t>::min()});
  tree.n = int32_t(last - entries);
  if (tree.n == 0) return;
  T* sorted = workspace.allocate<T>(3 * int64_t{tree.n});
  int32_t* order = workspace.allocate<int32_t>(tree.n);
  parallel_rows(tree.n, 1 << 14, [&](int64_t i) {
    order[i] = entries[i].second;
    std::copy_n(points + 3 * int64_t{order[i]}, 3, sorted + 3 * i);
  });
  tree.points = sorted;
  tree.order = order;
  make_knn_boxes(tree, workspace, nullptr);
  with_knn_length(k, [&]<int K>() {
    parallel_rows(tree.n, 1 << 10, [&](int64_t i) { knn_row<T, K>(tree, int32_t(i), k, distances); });
  });
}

BLITZGS_FOR_BOTH_DTYPES(knn_distances);

}  // namespace blitzgs::cpu
