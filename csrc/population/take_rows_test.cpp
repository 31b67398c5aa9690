// SPDX-License-Identifier: Apache-2.0
#include "population/take_rows.h"

#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

using namespace blitzgs;

TEST_CASE("rows are old, new or zero", "[take_rows]") {
  const std::vector<std::int32_t> column{1, 2, 3, 4}, fresh{5, 6};
  const std::vector<std::int64_t> rows{1, 2, 0};
  std::vector<std::int32_t> out(6, -1);
  const auto bytes = [](const auto& values) { return reinterpret_cast<const std::byte*>(values.data()); };
  TakeRows take{.column = bytes(column),
                .fresh = bytes(fresh),
                .out = reinterpret_cast<std::byte*>(out.data()),
                .rows = rows.data(),
                .n = 3,
                .count = 2,
                .row_bytes = 2 * sizeof(std::int32_t)};
  TestWorkspace workspace;
  cpu::take_rows(take, workspace, nullptr);
  REQUIRE(out == std::vector<std::int32_t>{3, 4, 5, 6, 1, 2});
  take.fresh = nullptr;
  cpu::take_rows(take, workspace, nullptr);
  REQUIRE(out == std::vector<std::int32_t>{3, 4, 0, 0, 1, 2});
}
