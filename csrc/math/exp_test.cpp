// SPDX-License-Identifier: Apache-2.0
#include "math/exp.h"

#include <algorithm>
#include <limits>

#include "common/catch.h"
#include "math/lanes.h"

namespace {
using Lanes = blitzgs::PlainLanes<float>;
float exp2_of(float x) { return blitzgs::exp2_nonpositive(Lanes::broadcast(x)).v[3]; }
}  // namespace

TEST_CASE("2^x is accurate to an ulp for x <= 0") {
  double worst = 0;
  for (int i = 0; i <= 400000; ++i) {
    const float x = -126.0f * static_cast<float>(i) / 400000.0f;
    const double exact = std::exp2(static_cast<double>(x));
    worst = std::max(worst, std::fabs(exp2_of(x) - exact) / exact);
  }
  REQUIRE(worst < 1.1e-7);
  REQUIRE(exp2_of(0.0f) == 1.0f);
  REQUIRE(exp2_of(-126.0f) == exp2_of(-1e30f));
  REQUIRE(std::isnan(exp2_of(std::numeric_limits<float>::quiet_NaN())));
}

TEST_CASE("lanes treat NaN as the vector instructions do") {
  const Lanes nan = Lanes::broadcast(std::numeric_limits<float>::quiet_NaN()), one = Lanes::broadcast(1.0f);
  REQUIRE(Lanes::min(nan, one).v[0] == 1.0f);
  REQUIRE(std::isnan(Lanes::min(one, nan).v[0]));
  REQUIRE(!Lanes::greater_equal(nan, one).any());
  REQUIRE(nan.to_int().v[0] == INT32_MIN);
  REQUIRE(Lanes::iota().sum() == 28.0f);
}
