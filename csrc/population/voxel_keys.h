// SPDX-License-Identifier: Apache-2.0
// Voxel keys: the cell of each point in a regular grid, as one sortable integer.
//
//   c = floor((p - origin) / voxel_size) per axis, clamped to [0, 2^21);  key = c.x | c.y << 21 | c.z << 42
//
// points [N, 3], origin 3 values in the unit of the points, keys int64 [N]. A point that is not finite gets
// the key -1. The division is done in double, so keys do not depend on the rounding of the dtype.
// Deterministic, O(N).
#pragma once
#include <cmath>
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

struct VoxelGrid {
  double origin[3];
  double voxel_size;
};

template <class T>
BLITZGS_HD std::int64_t voxel_key(const T* point, const VoxelGrid& grid) {
  constexpr double kMaxCell = (1 << 21) - 1;
  std::int64_t key = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const double cell = std::floor((static_cast<double>(point[axis]) - grid.origin[axis]) / grid.voxel_size);
    if (!(std::fabs(cell) <= 1e300)) return -1;
    const double clamped = cell < 0 ? 0 : (cell > kMaxCell ? kMaxCell : cell);
    key |= static_cast<std::int64_t>(clamped) << (21 * axis);
  }
  return key;
}

template <class T>
struct VoxelKeys {
  const T* points;
  VoxelGrid grid;
  std::int64_t* keys;
  std::int64_t n;

  BLITZGS_HD void operator()(std::int64_t i) const { keys[i] = voxel_key(points + 3 * i, grid); }
};

}  // namespace blitzgs
