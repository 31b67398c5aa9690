// SPDX-License-Identifier: Apache-2.0
#include "population/copy_rows.h"

#include <vector>

#include "common/catch.h"

using namespace blitzgs;

TEST_CASE("rows are copied to their places or set to zero", "[copy_rows]") {
  const std::vector<std::int32_t> column{1, 2, 3, 4, 5, 6};
  const std::vector<std::int64_t> from{2, 0}, to{1, 3};
  std::vector<std::int32_t> out(8, -1);
  CopyRows copy{.column = reinterpret_cast<const std::byte*>(column.data()),
                .from = from.data(),
                .out = reinterpret_cast<std::byte*>(out.data()),
                .to = to.data(),
                .n = 2,
                .row_bytes = 2 * sizeof(std::int32_t)};
  cpu::copy_rows(copy, nullptr);
  REQUIRE(out == std::vector<std::int32_t>{-1, -1, 5, 6, -1, -1, 1, 2});
  copy.from = nullptr;
  cpu::copy_rows(copy, nullptr);
  REQUIRE(out == std::vector<std::int32_t>{-1, -1, 1, 2, -1, -1, 3, 4});
  copy.column = nullptr;
  copy.to = nullptr;
  cpu::copy_rows(copy, nullptr);
  REQUIRE(out == std::vector<std::int32_t>{0, 0, 0, 0, -1, -1, 3, 4});
}
