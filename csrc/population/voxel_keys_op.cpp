// SPDX-License-Identifier: Apache-2.0
#include "population/voxel_keys.h"

#include "common/op.h"

namespace blitzgs {
namespace {

Tensor voxel_keys(const Tensor& points, const std::vector<double>& origin, double voxel_size) {
  check_floating("voxel_keys", "points", points);
  check_shape("voxel_keys", "points", points, {-1, 3});
  STD_TORCH_CHECK(origin.size() == 3, "blitzgs::voxel_keys: origin must have 3 values, got ", origin.size());
  STD_TORCH_CHECK(voxel_size > 0, "blitzgs::voxel_keys: voxel_size must be positive, got ", voxel_size);
  const Tensor rows = as_contiguous(points);
  Tensor keys = make_empty(rows, {rows.size(0)}, ScalarType::Long);
  DeviceScope scope(rows);
  const VoxelGrid grid{{origin[0], origin[1], origin[2]}, voxel_size};
  dispatch_floating(rows, [&](auto zero) {
    using T = decltype(zero);
    backend::voxel_keys(data<T>(rows), rows.size(0), grid, mutable_data<std::int64_t>(keys), scope.workspace,
                        scope.stream);
  });
  return keys;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("voxel_keys", TORCH_BOX(&blitzgs::voxel_keys)); }
