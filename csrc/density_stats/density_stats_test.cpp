// SPDX-License-Identifier: Apache-2.0
#include "density_stats/density_stats.h"

#include "common/catch.h"

TEST_CASE("the radius is three standard deviations of the longer axis, rounded up") {
  const double round[3] = {1.0 / 16, 0, 1.0 / 16};  // sigma 4: the root term is clamped at sqrt(0.1)
  REQUIRE(blitzgs::three_sigma_radius(round) == std::ceil(3 * std::sqrt(16 + std::sqrt(0.1))));
  const double angle = 0.6, c = std::cos(angle), s = std::sin(angle);
  const double a = 1.0 / 100, b = 1.0 / 4;  // sigma 10 and 2
  const double turned[3] = {c * c * a + s * s * b, c * s * (a - b), s * s * a + c * c * b};
  REQUIRE(blitzgs::three_sigma_radius(turned) == Approx(30).margin(1));
  const double flat[3] = {1, 1, 1};
  REQUIRE(blitzgs::three_sigma_radius(flat) == 0);
}
