// SPDX-License-Identifier: Apache-2.0
#include "population/knn.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

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
