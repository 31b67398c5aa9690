// SPDX-License-Identifier: Apache-2.0
#include "common/catch.h"
#include "population/density.h"
#include "population/knn.h"

using namespace blitzgs;

TEST_CASE("the radius of a thin splat is right as long as floats can tell, and then large") {
  const double angle = 0.7, c = std::cos(angle), s = std::sin(angle);
  for (const double sigma : {30.0, 100.0, 300.0, 1000.0, 3000.0, 9000.0}) {
    const double a = 1 / (sigma * sigma), b = 1 / 0.3;
    const float conic[3] = {float(c * c * a + s * s * b), float(c * s * (a - b)),
                            float(s * s * a + c * c * b)};
    const double found = blitzgs::three_sigma_radius(conic);
    CHECK(found > 3 * std::min(sigma, 1000.0) * 0.8);
    if (sigma <= 300) CHECK(found == Approx(3 * sigma).epsilon(0.05));
  }
}

TEST_CASE("nearest neighbours match brute force, around duplicates and a point that is not finite") {
  std::vector<double> points;
  for (int i = 0; i < 200; ++i) {
    const double t = 0.37 * i;
    for (const double x : {std::sin(t), std::cos(1.7 * t), std::floor(t) / 10}) points.push_back(x);
  }
  std::copy_n(points.data(), 3, points.data() + 3 * 50);
  points[3 * 9 + 1] = std::numeric_limits<double>::quiet_NaN();
  const int n = 200, k = 6;
  std::vector<double> distances(n * k);
  blitzgs::TestWorkspace workspace;
  blitzgs::cpu::knn_distances(points.data(), n, k, distances.data(), workspace, nullptr);
  for (int i = 0; i < n; ++i) {
    std::vector<double> all;
    for (int j = 0; j < n; ++j) {
      double square = 0;
      for (int axis = 0; axis < 3; ++axis) square += std::pow(points[3 * i + axis] - points[3 * j + axis], 2);
      if (j != i && std::isfinite(square)) all.push_back(std::sqrt(square));
    }
    all.resize(n, std::numeric_limits<double>::infinity());
    std::sort(all.begin(), all.end());
    for (int j = 0; j < k; ++j) {
      if (std::isinf(all[j])) {
        REQUIRE(std::isinf(distances[i * k + j]));
      } else {
        REQUIRE(distances[i * k + j] == Approx(all[j]).margin(1e-15));
      }
    }
  }
}
