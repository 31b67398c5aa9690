// SPDX-License-Identifier: Apache-2.0
#include "adam/position_noise.h"

#include <vector>

#include "common/catch.h"

TEST_CASE("draws have the moments of a standard normal") {
  double sum = 0, squares = 0, cubes = 0;
  constexpr int kDraws = 100000;
  for (int i = 0; i < kDraws; ++i) {
    const double x = blitzgs::normal_of(blitzgs::hash_key(blitzgs::hash_key(0, 42), i));
    sum += x, squares += x * x, cubes += x * x * x;
  }
  REQUIRE(sum / kDraws == Approx(0).margin(0.015));
  REQUIRE(squares / kDraws == Approx(1).margin(0.02));
  REQUIRE(cubes / kDraws == Approx(0).margin(0.05));
}

TEST_CASE("a flat, turned Gaussian moves in its plane alone, and an opaque one stays") {
  const double half = std::sqrt(0.5);
  double means[6] = {1, 2, 3, 1, 2, 3};
  const double quats[8] = {half, half, 0, 0, half, half, 0, 0};  // a quarter turn about x: z becomes -y
  const double flat[6] = {0, 0, -30, 0, 0, -30};
  const double opacities[2] = {-9, 1};
  const std::int64_t ids[2] = {7, 8};
  const std::int32_t visible[2] = {0, 1};
  const blitzgs::PositionNoiseArgs<double> args{means, quats, flat, opacities, ids, visible,
                                                2,     3,     5,    0.005,     0.1};
  blitzgs::position_noise_of(args, 0);
  blitzgs::position_noise_of(args, 1);
  REQUIRE(means[0] != 1);
  REQUIRE(means[1] == Approx(2).margin(1e-9));
  REQUIRE(means[2] != 3);
  REQUIRE((means[3] == 1 && means[4] == 2 && means[5] == 3));
}
