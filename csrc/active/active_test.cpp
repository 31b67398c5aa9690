// SPDX-License-Identifier: Apache-2.0
#include <limits>
#include <vector>

#include "active/blocks.h"
#include "active/cull_mask.h"
#include "active/pool.h"
#include "active/view_gate.h"
#include "common/catch.h"
#include "common/test_workspace.h"

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

TEST_CASE("a mask by sectors has the bits of the mask by rows, and comes back", "[cull_mask]") {
  constexpr std::int64_t kRows = 300, kWords = 2, kColumns = 32 * kWords;
  std::vector<std::int32_t> rows(kRows * kWords), sectors(2 * kColumns * kSectorWords, -1), back(rows.size());
  std::uint32_t state = 1;
  for (std::int32_t& word : rows) word = static_cast<std::int32_t>(state = 1664525u * state + 1013904223u);
  cpu::sectors_of_rows({rows.data(), sectors.data(), kRows, kWords}, nullptr);
  for (std::int64_t row = 0; row < kRows; ++row) {
    for (std::int64_t column = 0; column < kColumns; ++column) {
      const auto word = static_cast<std::uint32_t>(rows[row * kWords + column / 32]);
      REQUIRE(sector_bit(sectors.data(), kColumns, column, row) == ((word >> column % 32 & 1u) != 0));
    }
  }
  cpu::rows_of_sectors({back.data(), sectors.data(), kRows, kWords}, nullptr);
  REQUIRE(back == rows);
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

TEST_CASE("blocks leave and come at once", "[pool]") {
  // A slot and three blocks of 256 rows of one int16.
  constexpr std::int64_t kRows = 256;
  std::vector<std::int16_t> pool(2 * kRows), table(3 * kRows), kept(3 * kRows, 7), pool_kept(2 * kRows, 8);
  for (std::int64_t i = 0; i < 3 * kRows; ++i) table[i] = static_cast<std::int16_t>(i);
  for (std::int64_t i = 0; i < 2 * kRows; ++i) pool[i] = static_cast<std::int16_t>(-1 - i);
  const auto bytes = [](auto& values) { return reinterpret_cast<std::byte*>(values.data()); };
  const std::vector<std::int32_t> slots{1, 0}, leaving{2, -1}, coming{0, -1};
  SwapBlocks swap{slots.data(), leaving.data(), coming.data(), 2, {}, 2};
  swap.columns[0] = {bytes(pool), bytes(table), 2 * kRows, true};
  swap.columns[1] = {bytes(pool_kept), bytes(kept), 2 * kRows, false};
  TestWorkspace workspace;
  cpu::swap_blocks(swap, workspace, nullptr);
  for (std::int16_t i = 0; i < kRows; ++i) {
    REQUIRE(table[i] == i);
    REQUIRE(table[2 * kRows + i] == -1 - kRows - i);
    REQUIRE(pool[i] == -1 - i);
    REQUIRE(pool[kRows + i] == i);
    REQUIRE(kept[2 * kRows + i] == 7);
    REQUIRE(pool_kept[kRows + i] == 7);
  }
}

TEST_CASE("views of their own sizes see blocks", "[pool]") {
  const std::vector<float> identity{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  const std::vector<float> K{100, 0, 50, 0, 100, 40, 0, 0, 1};
  std::vector<float> viewmats, Ks;
  for (int view = 0; view < 2; ++view) {
    viewmats.insert(viewmats.end(), identity.begin(), identity.end());
    Ks.insert(Ks.end(), K.begin(), K.end());
  }
  const std::vector<std::int32_t> sizes{100, 80, 1000, 80};
  // In front, to the right, behind, and empty.
  const std::vector<float> bounds{0,     0,    5,    0.1f,  0.1f, 5.1f, 0.01f, 1,  20,    0, 5,
                                  20.1f, 0.1f, 5.1f, 0.01f, 1,    0,    0,     -5, 0,     0, -4,
                                  0.01f, 1,    1,    1,     5,    -1,   -1,    5,  0.01f, 1};
  std::vector<std::int32_t> seen(4, -1);
  TestWorkspace workspace;
  cpu::seen_blocks(
      {bounds.data(), 4, viewmats.data(), Ks.data(), sizes.data(), 2, 0.5f, 50.0f, 0.3f, seen.data()},
      workspace, nullptr);
  // The block to the right projects to x = 450, which is inside the wide second view only.
  REQUIRE(seen == std::vector<std::int32_t>{3, 2, 0, 0});
}

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
