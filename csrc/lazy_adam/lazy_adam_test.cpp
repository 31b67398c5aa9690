// SPDX-License-Identifier: Apache-2.0
#include "lazy_adam/lazy_adam.h"

#include <cmath>
#include <vector>

#include "common/catch.h"

namespace {

constexpr double kBeta1 = 0.9, kBeta2 = 0.999;
constexpr int kSteps = 400;

// A schedule of constant rate, tabulated as the contract says.
struct Schedule {
  std::vector<float> rates = std::vector<float>((kSteps + 1) * blitzgs::kAdamGroups, 0.01f);
  std::vector<double> table = std::vector<double>((kSteps + 1) * blitzgs::kAdamTable);

  Schedule() {
    const double ratio = kBeta1 / std::sqrt(kBeta2);
    double tail = 0;
    for (int t = kSteps; t >= 0; --t) {
      double* row = table.data() + t * blitzgs::kAdamTable;
      for (int g = 0; g < blitzgs::kAdamGroups; ++g) row[g] = tail;
      row[6] = std::pow(kBeta1, t);
      row[7] = std::pow(kBeta2, t);
      row[8] = std::pow(ratio, t);
      if (t == 0) continue;
      row[9] = 1 / (1 - row[6]);
      row[10] = 1 / std::sqrt(1 - row[7]);
      tail = ratio * (static_cast<double>(0.01f) * row[9] / row[10] + tail);
    }
  }

  blitzgs::AdamArgs<double> args(double eps) const {
    blitzgs::AdamArgs<double> a{};
    a.table = table.data();
    a.lr_table = rates.data();
    a.explicit_steps = kSteps;
    a.beta1 = kBeta1;
    a.beta2 = kBeta2;
    a.eps = eps;
    return a;
  }
};

}  // namespace

TEST_CASE("catching up in closed form equals the steps one by one, whatever eps weighs") {
  const Schedule schedule;
  for (const double eps : {1e-15, 1e-4, 1e-2, 1.0}) {
    for (const int gap : {1, 7, 300}) {
      const int from = 20;
      double p = 1, m = 0.02, v = 1e-3;
      double exact_p = p, exact_m = m, exact_v = v;
      for (int t = from + 1; t <= from + gap; ++t) {
        exact_m *= kBeta1;
        exact_v *= kBeta2;
        exact_p -= static_cast<double>(0.01f) * (exact_m / (1 - std::pow(kBeta1, t))) /
                   (std::sqrt(exact_v) / std::sqrt(1 - std::pow(kBeta2, t)) + eps);
      }
      const auto args = schedule.args(eps);
      blitzgs::adam_catch_up(args, blitzgs::adam_debt(args, from, from + gap), 0, p, m, v);
      REQUIRE(p == Approx(exact_p).epsilon(1e-12));
      REQUIRE(m == Approx(exact_m).epsilon(1e-12));
      REQUIRE(v == Approx(exact_v).epsilon(1e-12));
    }
  }
}

TEST_CASE("rows that never had a gradient do not move, and groups split the SH column") {
  const Schedule schedule;
  const auto args = schedule.args(1e-15);
  double p = 3, m = 0, v = 0;
  blitzgs::adam_catch_up(args, blitzgs::adam_debt(args, 5, 100), 2, p, m, v);
  REQUIRE(p == 3);
  REQUIRE(blitzgs::adam_group(4, 2) == 4);
  REQUIRE(blitzgs::adam_group(4, 3) == 5);
  REQUIRE(blitzgs::adam_group(1, 3) == 1);
}
