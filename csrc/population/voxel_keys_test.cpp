// SPDX-License-Identifier: Apache-2.0
#include "population/voxel_keys.h"

#include <limits>

#include "common/catch.h"

using blitzgs::voxel_key;
using blitzgs::VoxelGrid;

TEST_CASE("voxel keys pack x, y, z into 21 bits each and clamp") {
  const VoxelGrid grid{{-1.0, 0.0, 2.0}, 0.5};
  const double inside[3] = {0.25, 0.75, 4.0};
  REQUIRE(voxel_key(inside, grid) == (2 | (std::int64_t{1} << 21) | (std::int64_t{4} << 42)));
  const double below[3] = {-100.0, -100.0, -100.0};
  REQUIRE(voxel_key(below, grid) == 0);
  const double nan[3] = {std::numeric_limits<double>::quiet_NaN(), 0.0, 0.0};
  REQUIRE(voxel_key(nan, grid) == -1);
}
