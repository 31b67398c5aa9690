// SPDX-License-Identifier: Apache-2.0
#include "active/pool.h"

#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

using namespace blitzgs;

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
