// SPDX-License-Identifier: Apache-2.0
#include "render/render.h"

#include <vector>

#include "common/catch.h"

using namespace blitzgs;

TEST_CASE("splats go to their entries and come back", "[arrange_splats]") {
  // Two scenes of two views of three Gaussians; three splats, in columns of one and of two words.
  const std::vector<std::int32_t> images{0, 3, 2}, gaussians{2, 0, 1};
  const std::vector<std::uint32_t> ones{7, 8, 9}, twos{1, 2, 3, 4, 5, 6}, under{10, 11, 12, 20, 21, 22};
  std::vector<std::uint32_t> arranged_ones(12, 99), arranged_twos(24, 99);
  cpu::fill_entries({{nullptr, arranged_ones.data(), 1, 1}, 12, 3, 2, under.data()}, nullptr);
  cpu::fill_entries({{nullptr, arranged_twos.data(), 2, 2}, 12, 3, 2, nullptr}, nullptr);
  ArrangeSplats moves{nullptr, images.data(), gaussians.data(), 3, 3, 2, {}};
  moves.columns[0] = {ones.data(), arranged_ones.data(), 1, 1};
  moves.columns[1] = {twos.data(), arranged_twos.data(), 2, 2};
  cpu::arrange_splats(moves, false, nullptr);
  REQUIRE(arranged_ones == std::vector<std::uint32_t>{10, 11, 7, 10, 11, 12, 20, 9, 22, 8, 21, 22});
  REQUIRE(arranged_twos ==
          std::vector<std::uint32_t>{0, 0, 0, 0, 1, 2, 0, 0, 0, 0, 0, 0, 0, 0, 5, 6, 0, 0, 3, 4, 0, 0, 0, 0});
  std::vector<std::uint32_t> back(6, 99);
  moves.columns[0] = {arranged_twos.data(), back.data(), 2, 2};
  moves.n_columns = 1;
  cpu::arrange_splats(moves, true, nullptr);
  REQUIRE(back == twos);
}

TEST_CASE("an order of splats and rows of a longer table", "[arrange_splats]") {
  const std::vector<std::int64_t> order{2, 0, 1};
  const std::vector<std::uint32_t> table{1, 2, 0, 3, 4, 0, 5, 6, 0};
  std::vector<std::uint32_t> out(6, 99), back(6, 99);
  ArrangeSplats moves{order.data(), nullptr, nullptr, 3, 3, 1, {}};
  moves.columns[0] = {table.data(), out.data(), 2, 3};
  cpu::arrange_splats(moves, false, nullptr);
  REQUIRE(out == std::vector<std::uint32_t>{5, 6, 1, 2, 3, 4});
  moves.columns[0] = {out.data(), back.data(), 2, 2};
  cpu::arrange_splats(moves, true, nullptr);
  REQUIRE(back == std::vector<std::uint32_t>{1, 2, 3, 4, 5, 6});
}
