// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <vector>

#include "active/blocks.h"
#include "active/view_gate.h"
#include "common/catch.h"

using namespace blitzgs;

TEST_CASE("a box is dropped where a view cannot see it, and known to be seen whole") {
  // A camera at the origin that looks along +z at 100 x 80 pixels.
  const float viewmat[] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  const float K[] = {100, 0, 50, 0, 100, 40, 0, 0, 1};
  const Frustum view = make_frustum({viewmat, K, 100, 80, 0.5f, 50.0f, 0.3f}, 0);
  const auto visibility = [&](const SweptBox& box) { return visibility_of(view, box, kRowSlack); };
  const auto seen = [&](float x, float y, float z, float sigma) {
    return visibility({{x, y, z}, {x, y, z}, sigma}).any;
  };
  REQUIRE((seen(0, 0, 5, 0.01f) && seen(20, 0, 5, 20)));
  REQUIRE_FALSE((seen(0, 0, 0.4f, 0.01f) || seen(0, 0, -5, 0.01f) || seen(0, 0, 51, 0.01f)));
  REQUIRE_FALSE((seen(20, 0, 5, 0.01f) || seen(0, -20, 5, 0.01f) || visibility(empty_box()).any));
  REQUIRE(visibility({{-0.5f, -0.4f, 3}, {0.5f, 0.4f, 5}, 2}).all);
  REQUIRE_FALSE(visibility({{-0.5f, -0.4f, 0.4f}, {0.5f, 0.4f, 5}, 2}).all);
  REQUIRE_FALSE(visibility({{-0.5f, -0.4f, 3}, {20, 0.4f, 5}, 100}).all);
}

TEST_CASE("pending steps widen a row's box along its drift, and rows that are not finite have none") {
  const std::vector<float> means = {1, 2, 3, 4, NAN, 6}, m = {2, 0, 0, 0, 0, 0}, zeros(6), ones(6, 1.0f);
  const std::vector<std::int32_t> last_step(2, 1), moment_step(2, 0);
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

TEST_CASE("a sector tells whether any and whether all of its rows have the bit", "[cull_mask]") {
  std::int32_t sector[kSectorWords] = {0, 1 << 8};
  REQUIRE((sector_bits(sector, 41).any && !sector_bits(sector, 40).any));  // row 40 is beyond the count
  sector[0] = -1, sector[1] = (1 << 8) - 1;
  REQUIRE((sector_bits(sector, 40).all && !sector_bits(sector, 41).all));
}

TEST_CASE("Morton keys interleave the axes") {
  const std::vector<float> points = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1};
  std::vector<std::int64_t> keys(5);
  TestWorkspace workspace;
  cpu::morton_keys(points.data(), 5, keys.data(), workspace, nullptr);
  REQUIRE((keys[0] == 0 && keys[1] < keys[2] && keys[2] < keys[3] && keys[3] < keys[4]));
}
