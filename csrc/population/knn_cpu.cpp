// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <utility>

#include "common/parallel.h"
#include "population/knn.h"

namespace blitzgs::cpu {

template <class T>
void knn_distances(const T* points, std::int32_t n, int k, T* distances, Workspace& workspace, CudaStream) {
  std::fill_n(distances, std::int64_t{n} * k, std::numeric_limits<T>::infinity());
  if (n == 0) return;
  using Entry = std::pair<std::uint64_t, std::int32_t>;
  Entry* entries = workspace.allocate<Entry>(n);
  const MortonFrame frame = morton_frame_of(points, n);
  parallel_rows(n, 1 << 14, [&](std::int64_t i) {
    entries[i] = {morton_code(points + 3 * i, frame), static_cast<std::int32_t>(i)};
  });
  std::sort(entries, entries + n);

  KnnTree<T> tree{};
  const Entry* last = std::lower_bound(entries, entries + n,
                                       Entry{~std::uint64_t{0}, std::numeric_limits<std::int32_t>::min()});
  tree.n = static_cast<std::int32_t>(last - entries);
  if (tree.n == 0) return;
  T* sorted = workspace.allocate<T>(3 * std::int64_t{tree.n});
  std::int32_t* order = workspace.allocate<std::int32_t>(tree.n);
  parallel_rows(tree.n, 1 << 14, [&](std::int64_t i) {
    order[i] = entries[i].second;
    std::copy_n(points + 3 * std::int64_t{order[i]}, 3, sorted + 3 * i);
  });
  tree.points = sorted;
  tree.order = order;
  KnnBox<T>* boxes = workspace.allocate<KnnBox<T>>(plan_knn_levels(tree.n, tree));
  tree.boxes = boxes;
  for (int level = 0; level < tree.levels; ++level) {
    parallel_rows(tree.count[level], 1 << 12, [&](std::int64_t i) {
      boxes[tree.offset[level] + i] = make_knn_box(tree, level, static_cast<std::int32_t>(i));
    });
  }
  with_knn_length(k, [&]<int K>() {
    parallel_rows(tree.n, 1 << 10,
                  [&](std::int64_t i) { knn_row<T, K>(tree, static_cast<std::int32_t>(i), k, distances); });
  });
}

template void knn_distances<float>(const float*, std::int32_t, int, float*, Workspace&, CudaStream);
template void knn_distances<double>(const double*, std::int32_t, int, double*, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
