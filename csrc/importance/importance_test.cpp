// SPDX-License-Identifier: Apache-2.0
#include "common/catch.h"
#include "importance/mass_cut.h"

using namespace blitzgs;

TEST_CASE("a cut takes the heaviest and, of equal ones, those of the smallest ids") {
  const std::vector<int64_t> weights{5, 1, 5, 0, 5, 80}, ids{30, 11, 10, 12, 20, 99};
  const std::vector<int32_t> segments(6, 0), owners{0, 1, 2, 3, 4, 5};
  SegmentSearch search{};
  std::vector<int64_t> sums(kDigits, 0);
  std::vector<int32_t> listed(7);
  bool chosen[6];
  // 90 of 96: the heaviest, and two of the three that weigh 5.
  const MassCutArgs args{weights.data(), segments.data(), owners.data(), ids.data(), 6, 1, 90, 96,
                         &search,        sums.data(),     listed.data(), chosen};
  cpu::mass_cut(args, 0, kSteps, nullptr);
  REQUIRE(std::vector<bool>(chosen, chosen + 6) == std::vector<bool>{false, false, true, false, true, true});
}
