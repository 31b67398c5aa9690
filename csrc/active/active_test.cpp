// SPDX-License-Identifier: Apache-2.0
#include <limits>
#include <vector>

#include "active/blocks.h"
#include "active/view_gate.h"
#include "common/catch.h"

using namespace blitzgs;

namespace {

// A camera at the origin that looks along +z at 100 x 80 pixels.
struct Scene {
  std::vector<float> viewmat = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  std::vector<float> K = {100, 0, 50, 0, 100, 40, 0, 0, 1};

  blitzgs::Frustum view() const {
    return blitzgs::make_frustum({viewmat.data(), K.data(), 100, 80, 0.5f, 50.0f, 0.3f}, 0);
  }
};

blitzgs::SweptBox point(float x, float y, float z, float sigma) { return {{x, y, z}, {x, y, z}, sigma}; }

blitzgs::Visibility visibility(const blitzgs::SweptBox& box) {
  return blitzgs::visibility_of(Scene().view(), box, blitzgs::kRowSlack);
}

bool seen(const blitzgs::SweptBox& box) { return visibility(box).any; }

}  // namespace

TEST_CASE("a box is dropped where no view can see it") {
  REQUIRE(seen(point(0, 0, 5, 0.01f)));
  REQUIRE_FALSE(seen(point(0, 0, 0.4f, 0.01f)));  // nearer than the near plane
  REQUIRE_FALSE(seen(point(0, 0, -5, 0.01f)));
  REQUIRE_FALSE(seen(point(0, 0, 51, 0.01f)));
  REQUIRE_FALSE(seen(point(20, 0, 5, 0.01f)));
  REQUIRE_FALSE(seen(point(0, -20, 5, 0.01f)));
  REQUIRE(seen(point(20, 0, 5, 20)));  // large enough to reach the image
  REQUIRE(seen({{-30, -30, -30}, {30, 30, 30}, 0.01f}));
  REQUIRE_FALSE(seen(blitzgs::empty_box()));
}

TEST_CASE("a view sees all of a box whose every point it sees whatever its size") {
  REQUIRE(visibility({{-0.5f, -0.4f, 3}, {0.5f, 0.4f, 5}, 2}).all);
  REQUIRE_FALSE(visibility({{-0.5f, -0.4f, 0.4f}, {0.5f, 0.4f, 5}, 2}).all);
  REQUIRE_FALSE(visibility({{-0.5f, -0.4f, 3}, {20, 0.4f, 5}, 100}).all);
}

TEST_CASE("pending steps widen a row's box along its drift, and rows that are not finite have none") {
  std::vector<float> means = {1, 2, 3, 4, std::numeric_limits<float>::quiet_NaN(), 6};
  std::vector<float> scales(6, 0.0f), m(6, 0.0f), v(6, 1.0f), still(6, 0.0f);
  m[0] = 2;
  std::vector<std::int32_t> last_step(2, 1), moment_step(2, 0);
  std::vector<double> table(3 * blitzgs::kAdamTable, 0.0);
  table[1 * blitzgs::kAdamTable] = 0.5;  // the tail of the means at step 1
  table[1 * blitzgs::kAdamTable + blitzgs::kRatioPower] = 0.5;
  const blitzgs::BlockRows rows{
      means.data(), scales.data(),    m.data(),           v.data(),     still.data(),
      v.data(),     last_step.data(), moment_step.data(), table.data(), 2};
  const blitzgs::SweptBox box = blitzgs::sweep_row(rows, 0);
  REQUIRE(box.low[0] == Approx(0.5).margin(1e-4));
  REQUIRE(box.high[0] == 1);
  REQUIRE(box.low[1] == box.high[1]);
  REQUIRE(box.sigma == Approx(1).epsilon(1e-4));
  REQUIRE(blitzgs::sweep_row(rows, 1).low[0] > blitzgs::sweep_row(rows, 1).high[0]);

  float bounds[blitzgs::kBlockBounds];
  blitzgs::TestWorkspace workspace;
  blitzgs::cpu::update_block_bounds(rows, nullptr, 0, bounds, workspace, nullptr);
  REQUIRE(bounds[0] == box.low[0]);
  REQUIRE(bounds[3] == 1);
  REQUIRE(bounds[7] == 0);
}

TEST_CASE("a sector tells whether any and whether all of its rows have the bit", "[cull_mask]") {
  std::int32_t sector[kSectorWords] = {};
  REQUIRE_FALSE(sector_bits(sector, 256).any);
  sector[1] = 1 << 8;
  REQUIRE(sector_bits(sector, 256).any);
  REQUIRE(sector_bits(sector, 41).any);
  REQUIRE_FALSE(sector_bits(sector, 40).any);  // row 40 is beyond the count
  sector[0] = -1, sector[1] = (1 << 8) - 1;
  REQUIRE(sector_bits(sector, 40).all);
  REQUIRE_FALSE(sector_bits(sector, 41).all);
}

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
