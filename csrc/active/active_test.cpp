// SPDX-License-Identifier: Apache-2.0
#include "active/blocks.h"
#include "active/view_gate.h"
#include "common/catch.h"

using namespace blitzgs;

TEST_CASE("pending steps widen a row's box along its drift, and rows that are not finite have none") {
  const std::vector<float> means = {1, 2, 3, 4, NAN, 6}, m = {2, 0, 0, 0, 0, 0}, zeros(6), ones(6, 1.0f);
  const std::vector<int32_t> last_step(2, 1), moment_step(2, 0);
  std::vector<double> table(3 * kAdamTable);
  table[kAdamTable] = table[kAdamTable + kRatioPower] = 0.5;  // row 1: the tail of the means, and q_0
  const BlockRows rows{means.data(), zeros.data(),     m.data(),           ones.data(),  zeros.data(),
                       ones.data(),  last_step.data(), moment_step.data(), table.data(), 2};
  const SweptBox box = sweep_row(rows, 0);
  REQUIRE(box.low[0] == Approx(0.5).margin(1e-4));
  REQUIRE((box.high[0] == 1 && box.low[1] == 2 && box.high[1] == 2));
  REQUIRE(sweep_row(rows, 1).low[0] > sweep_row(rows, 1).high[0]);
  float bounds[kBlockBounds];
  TestWorkspace workspace;
  cpu::update_block_bounds(rows, nullptr, 0, bounds, workspace, nullptr);
  REQUIRE((bounds[0] == box.low[0] && bounds[3] == 1 && bounds[7] == 0));
}

TEST_CASE("Morton keys interleave the axes") {
  const std::vector<float> points = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1};
  std::vector<int64_t> keys(5);
  TestWorkspace workspace;
  cpu::morton_keys(points.data(), 5, keys.data(), workspace, nullptr);
  REQUIRE((keys[0] == 0 && keys[1] < keys[2] && keys[2] < keys[3] && keys[3] < keys[4]));
}
