// SPDX-License-Identifier: Apache-2.0
#include "active/cull_mask.h"

#include <vector>

#include "common/catch.h"

using namespace blitzgs;

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
