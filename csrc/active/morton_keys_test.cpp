// SPDX-License-Identifier: Apache-2.0
#include "active/morton_keys.h"

#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

TEST_CASE("Morton keys interleave the axes") {
  const std::vector<float> points = {0, 0, 0, 1, 1, 1, 0, 0, 1, 1, 0, 0, 0, 1, 0};
  std::vector<std::int64_t> keys(5);
  blitzgs::TestWorkspace workspace;
  blitzgs::cpu::morton_keys(points.data(), 5, keys.data(), workspace, nullptr);
  REQUIRE(keys[0] == 0);
  REQUIRE(keys[3] < keys[4]);  // x is the lowest bit, z the highest
  REQUIRE(keys[4] < keys[2]);
  REQUIRE(keys[2] < keys[1]);
}
