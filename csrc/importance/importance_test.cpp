// SPDX-License-Identifier: Apache-2.0
#include "common/catch.h"
#include "importance/mass_cut.h"

using namespace blitzgs;

TEST_CASE("first digits grow with the number and fit their table") {
  int before = -1;
  for (int exponent = 0; exponent < 63; ++exponent) {
    const std::int64_t power = std::int64_t{1} << exponent;
    REQUIRE((first_digit(power - 1) < first_digit(power) && first_digit(power) > before));
    before = first_digit(power);
  }
  REQUIRE(first_digit(std::numeric_limits<std::int64_t>::max()) < kFirstDigits);
}

TEST_CASE("the share of a total is rounded up and does not overflow") {
  REQUIRE((share_of(100, 99, 100) == 99 && share_of(101, 99, 100) == 100 && share_of(7, 0, 1) == 0));
  REQUIRE(share_of((std::int64_t{1} << 61) + 1, 999'999'999, 1'000'000'000) == 2'305'843'006'907'850'944);
}

TEST_CASE("a cut takes the heaviest and, of equal ones, those of the smallest ids") {
  const std::vector<std::int64_t> weights{5, 1, 5, 0, 5, 80}, ids{30, 11, 10, 12, 20, 99};
  const std::vector<std::int32_t> segments(6, 0), owners{0, 1, 2, 3, 4, 5};
  SegmentSearch search{};
  std::vector<std::int64_t> sums(kDigits, 0);
  std::vector<std::int32_t> listed(7);
  bool chosen[6];
  // 90 of 96: the heaviest, and two of the three that weigh 5.
  const MassCutArgs args{weights.data(), segments.data(), owners.data(), ids.data(), 6, 1, 90, 96,
                         &search,        sums.data(),     listed.data(), chosen};
  cpu::mass_cut(args, 0, kSteps, nullptr);
  REQUIRE(std::vector<bool>(chosen, chosen + 6) == std::vector<bool>{false, false, true, false, true, true});
}
