// SPDX-License-Identifier: Apache-2.0
#include "active/view_gate.h"

#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

namespace {

// Three rows at distance 3 of a camera at (1, 0, 0), with levels 0 to 2, seen by views 0 and 1 alike.
struct Rows {
  std::vector<float> means = {1, 3, 0, 1, 0, 3, 4, 0, 0};
  std::vector<std::uint8_t> level = {0, 1, 2};
  std::vector<std::int32_t> ids = {0, 1, 2}, views = {3, 3, 3};
  std::vector<std::int32_t> cull = std::vector<std::int32_t>(32 * blitzgs::kSectorWords);
  std::vector<float> viewmats = {0, 0, 1, 0,  0, 1, 0, 0, -1, 0, 0, 1, 0, 0, 0, 1,
                                 1, 0, 0, -1, 0, 1, 0, 0, 0,  0, 1, 0, 0, 0, 0, 1};

  blitzgs::ViewGateArgs args() {
    blitzgs::ViewGateArgs args{};
    args.ids = ids.data(), args.views = views.data(), args.capacity = 3;
    args.means = means.data(), args.viewmats = viewmats.data();
    args.rules.level = level.data(), args.rules.cull = cull.data(), args.rules.cull_columns = 32;
    args.rules.n_views = 2, args.rules.n_levels = 2;
    return args;
  }

  std::vector<std::int32_t> left(const blitzgs::ViewGateArgs& args) {
    blitzgs::TestWorkspace workspace;
    blitzgs::cpu::gate_views(args, workspace, nullptr);
    return views;
  }
};

}  // namespace

TEST_CASE("the centre of a camera does not depend on its rotation") {
  const Rows rows;
  for (int view = 0; view < 2; ++view) {
    float centre[3];
    blitzgs::camera_centre(rows.viewmats.data() + 16 * view, centre);
    REQUIRE(centre[0] == 1);
    REQUIRE(centre[1] == 0);
    REQUIRE(centre[2] == 0);
  }
}

TEST_CASE(
    "levels beyond their reach leave the views that have a gate, and a level beyond the last is the last") {
  Rows rows;
  blitzgs::ViewGateArgs args = rows.args();
  args.rules.lod_views = 1;
  args.rules.table.reach2[0] = 1e30f, args.rules.table.reach2[1] = 8.99f;
  REQUIRE(rows.left(args) == std::vector<std::int32_t>{3, 2, 2});
  args.rules.table.reach2[1] = 9;
  rows.views = {3, 3, 2};
  REQUIRE(rows.left(args) == std::vector<std::int32_t>{3, 3, 2});
}

TEST_CASE("the bits of a column leave the view that has it") {
  Rows rows;
  blitzgs::ViewGateArgs args = rows.args();
  args.rules.cull_views = 2;
  args.rules.table.columns[0] = -1, args.rules.table.columns[1] = 31;
  rows.cull[blitzgs::sector_at(0, 32, 31)] = 1 << 1;
  rows.cull[blitzgs::sector_at(0, 32, 30)] = 1 << 2;
  REQUIRE(rows.left(args) == std::vector<std::int32_t>{3, 1, 3});
}
