// SPDX-License-Identifier: Apache-2.0
#include "population/density_stats.h"

#include <algorithm>

#include "common/catch.h"

TEST_CASE("the radius is three standard deviations of the longer axis, rounded up") {
  const double round[3] = {1.0 / 16, 0, 1.0 / 16};  // sigma 4: the root term is clamped at sqrt(0.1)
  REQUIRE(blitzgs::three_sigma_radius(round) == std::ceil(3 * std::sqrt(16 + std::sqrt(0.1))));
  const double angle = 0.6, c = std::cos(angle), s = std::sin(angle);
  const double a = 1.0 / 100, b = 1.0 / 4;  // sigma 10 and 2
  const double turned[3] = {c * c * a + s * s * b, c * s * (a - b), s * s * a + c * c * b};
  REQUIRE(blitzgs::three_sigma_radius(turned) == Approx(30).margin(1));
  const double inverted[3] = {-1, 0, 1};
  REQUIRE(blitzgs::three_sigma_radius(inverted) == 0);
}

TEST_CASE("the radius of a thin splat is right as long as floats can tell, and then large") {
  const double angle = 0.7, c = std::cos(angle), s = std::sin(angle);
  for (const double sigma : {30.0, 100.0, 300.0, 1000.0, 3000.0, 9000.0}) {
    const double a = 1 / (sigma * sigma), b = 1 / 0.3;
    const float conic[3] = {static_cast<float>(c * c * a + s * s * b), static_cast<float>(c * s * (a - b)),
                            static_cast<float>(s * s * a + c * c * b)};
    const double found = blitzgs::three_sigma_radius(conic);
    CHECK(found > 3 * std::min(sigma, 1000.0) * 0.8);
    if (sigma <= 300) CHECK(found == Approx(3 * sigma).epsilon(0.05));
  }
}
