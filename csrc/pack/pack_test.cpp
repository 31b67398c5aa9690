// SPDX-License-Identifier: Apache-2.0
#include "pack/pack.h"

#include <cstdlib>
#include <numeric>
#include <vector>

#include "common/catch.h"

using namespace blitzgs;

namespace {
struct NoWorkspace final : Workspace {
  void* allocate_bytes(std::size_t) override { std::abort(); }
};
}  // namespace

TEST_CASE("pack gathers rows and unpack takes them apart", "[pack]") {
  const int n = 9000;  // more than one chunk
  std::vector<std::int32_t> a(2 * n), b(n), c(3 * n);
  std::iota(a.begin(), a.end(), 0);
  std::iota(b.begin(), b.end(), 100000);
  std::iota(c.begin(), c.end(), 200000);
  std::vector<std::int32_t> rows;
  for (int i = n - 1; i >= 0; i -= 2) rows.push_back(i);
  const PackColumns columns{{a.data(), b.data(), c.data()}, {0, 2, 3, 6}, 3};
  std::vector<std::int32_t> packed(6 * rows.size());
  NoWorkspace workspace;
  cpu::pack(columns, rows.data(), static_cast<std::int64_t>(rows.size()), packed.data(), workspace, nullptr);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const int r = rows[i];
    const std::vector<std::int32_t> expected{a[2 * r], a[2 * r + 1], b[r],
                                             c[3 * r], c[3 * r + 1], c[3 * r + 2]};
    REQUIRE(std::vector<std::int32_t>(packed.begin() + 6 * i, packed.begin() + 6 * i + 6) == expected);
  }
  std::vector<std::int32_t> a2(2 * rows.size()), b2(rows.size()), c2(3 * rows.size());
  const PackColumns parts{{a2.data(), b2.data(), c2.data()}, {0, 2, 3, 6}, 3};
  cpu::unpack(packed.data(), static_cast<std::int64_t>(rows.size()), parts, workspace, nullptr);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    REQUIRE(a2[2 * i + 1] == a[2 * rows[i] + 1]);
    REQUIRE(b2[i] == b[rows[i]]);
    REQUIRE(c2[3 * i + 2] == c[3 * rows[i] + 2]);
  }
}

TEST_CASE("add_group adds to the rows it names", "[pack]") {
  const std::vector<double> values{1, 2, 3, 4, 5, 6};
  const std::vector<std::int32_t> rows{2, 0, 3};
  std::vector<double> total{10, 10, 20, 20, 30, 30, 40, 40};
  NoWorkspace workspace;
  cpu::add_group(values.data(), rows.data(), 3, 2, total.data(), workspace, nullptr);
  REQUIRE(total == std::vector<double>{13, 14, 20, 20, 31, 32, 45, 46});
}
