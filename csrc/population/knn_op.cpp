// SPDX-License-Identifier: Apache-2.0
#include "common/op.h"
#include "population/knn.h"

namespace blitzgs {
namespace {

Tensor knn_distances(const Tensor& points, std::int64_t k) {
  check_floating("knn_distances", "points", points);
  check_shape("knn_distances", "points", points, {-1, 3});
  STD_TORCH_CHECK(k >= 1 && k <= kKnnMaxK, "blitzgs::knn_distances: k must be in [1, ", kKnnMaxK, "], got ",
                  k);
  const std::int64_t n = points.size(0);
  STD_TORCH_CHECK(n < (std::int64_t{1} << 31) - kKnnFan, "blitzgs::knn_distances: at most 2^31 points, got ",
                  n);
  const Tensor rows = as_contiguous(points);
  Tensor distances = make_empty(rows, {n, k});
  DeviceScope scope(rows);
  dispatch_floating(rows, [&](auto zero) {
    using T = decltype(zero);
    backend::knn_distances(data<T>(rows), static_cast<std::int32_t>(n), static_cast<int>(k),
                           mutable_data<T>(distances), scope.workspace, scope.stream);
  });
  return distances;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("knn_distances", TORCH_BOX(&blitzgs::knn_distances)); }
