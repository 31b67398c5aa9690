// SPDX-License-Identifier: Apache-2.0
#include "adam/lazy_adam.h"
#include "common/catch.h"

using namespace blitzgs;

namespace {

constexpr double kBeta1 = 0.9, kBeta2 = 0.999;
constexpr int kSteps = 400;

// A schedule of constant rate, tabulated as lazy_adam.h says.
struct Schedule {
  std::vector<double> table = std::vector<double>((kSteps + 1) * kAdamTable);

  Schedule() {
    double tails[kAdamOrders] = {};
    for (int t = kSteps; t >= 0; --t) {
      double* row = table.data() + t * kAdamTable;
      row[kBeta1Power] = std::pow(kBeta1, t), row[kBeta2Power] = std::pow(kBeta2, t);
      row[kRatioPower] = std::pow(kBeta1 / std::sqrt(kBeta2), t);
      row[kRootPower] = std::pow(kBeta2, 0.5 * t);
      const double first = 1 / (1 - row[kBeta1Power]), second = 1 / std::sqrt(1 - row[kBeta2Power]);
      for (int k = 0; k < kAdamOrders; ++k) {
        for (int g = 0; g < kAdamGroups; ++g) row[k * kAdamGroups + g] = tails[k];
        const double term = 0.01 * first * std::pow(second, k - 1);
        tails[k] = kBeta1 * std::pow(kBeta2, 0.5 * (k - 1)) * (term + tails[k]);
      }
    }
  }

  template <class T>
  AdamArgs<T> args() const {
    AdamArgs<T> a{};
    a.table = table.data();
    a.explicit_steps = kSteps;
    a.beta1 = kBeta1, a.beta2 = kBeta2, a.eps = 1e-15;
    return a;
  }
};

}  // namespace

TEST_CASE("late in a schedule no element needs its steps one by one, early those that eps concerns") {
  const Schedule schedule;
  const auto args = schedule.args<float>();
  REQUIRE(pending_steps(args, 300, 400).explicit_up_to < 0);
  REQUIRE(pending_steps(args, 20, 21).explicit_up_to < 0);  // a single step is exact anywhere
  REQUIRE(pending_steps(args, 20, 120).explicit_up_to > 1e-8f);
  REQUIRE(adam_drift(args, pending_steps(args, 5, 100), 2, 0.0f, 0.0f) == 0);  // never had a gradient
  REQUIRE((adam_group(4, 2) == 4 && adam_group(4, 3) == 5 && adam_group(1, 3) == 1));
}

TEST_CASE("a row moves until what is left of its drift is below rounding") {
  const Schedule schedule;
  auto args = schedule.args<double>();
  args.step = 400, args.explicit_steps = 187;
  REQUIRE((adam_moves(args, 30, 30) && adam_moves(args, 44, 40)));
  REQUIRE_FALSE(adam_moves(args, 400, 399));
  REQUIRE_FALSE(adam_moves(args, 399, 5));
}
