// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <vector>

#include "adam/lazy_adam_lanes.h"
#include "common/catch.h"

using namespace blitzgs;

namespace {

constexpr double kBeta1 = 0.9, kBeta2 = 0.999;
constexpr int kSteps = 400;

// A schedule of constant rate, tabulated as lazy_adam.h says.
struct Schedule {
  std::vector<float> rates = std::vector<float>((kSteps + 1) * blitzgs::kAdamGroups, 0.01f);
  std::vector<double> table = std::vector<double>((kSteps + 1) * blitzgs::kAdamTable);

  Schedule() {
    const double ratio = kBeta1 / std::sqrt(kBeta2);
    double tails[blitzgs::kAdamOrders] = {};
    for (int t = kSteps; t >= 0; --t) {
      double* row = table.data() + t * blitzgs::kAdamTable;
      row[blitzgs::kBeta1Power] = std::pow(kBeta1, t);
      row[blitzgs::kBeta2Power] = std::pow(kBeta2, t);
      row[blitzgs::kRatioPower] = std::pow(ratio, t);
      row[blitzgs::kRootPower] = std::pow(kBeta2, 0.5 * t);
      const double first = 1 / (1 - row[blitzgs::kBeta1Power]);
      const double second = 1 / std::sqrt(1 - row[blitzgs::kBeta2Power]);
      for (int k = 0; k < blitzgs::kAdamOrders; ++k) {
        for (int g = 0; g < blitzgs::kAdamGroups; ++g) row[k * blitzgs::kAdamGroups + g] = tails[k];
        if (t == 0) continue;
        const double term = static_cast<double>(0.01f) * first * std::pow(second, k - 1);
        tails[k] = ratio * std::pow(kBeta2, 0.5 * k) * (term + tails[k]);
      }
      if (t == 0) continue;
      row[blitzgs::kCorrection1] = first;
      row[blitzgs::kCorrection2] = second;
    }
  }

  template <class T>
  blitzgs::AdamArgs<T> args(double eps) const {
    blitzgs::AdamArgs<T> a{};
    a.table = table.data();
    a.lr_table = rates.data();
    a.explicit_steps = kSteps;
    a.beta1 = kBeta1;
    a.beta2 = kBeta2;
    a.eps = eps;
    return a;
  }
};

template <class T>
T drift(const blitzgs::AdamArgs<T>& args, int from, int to, int group, T m, T v) {
  const blitzgs::PendingSteps<T> steps = blitzgs::pending_steps(args, from, to);
  return blitzgs::adam_drift(args, steps, group, m, v);
}

}  // namespace

TEST_CASE("late in a schedule no element needs its steps one by one, early those that eps concerns") {
  const Schedule schedule;
  const auto args = schedule.args<float>(1e-15);
  REQUIRE(blitzgs::pending_steps(args, 300, 400).explicit_up_to < 0);
  REQUIRE(blitzgs::pending_steps(args, 20, 21).explicit_up_to < 0);  // a single step is exact anywhere
  REQUIRE(blitzgs::pending_steps(args, 20, 120).explicit_up_to > 1e-8f);
}

TEST_CASE("a row's moments decay to where its parameters stand and on to the target") {
  const Schedule schedule;
  auto args = schedule.args<double>(1e-15);
  std::int32_t last_step[3] = {30, 44, 399}, moment_step[3] = {30, 40, 5};
  args.last_step = last_step;
  args.moment_step = moment_step;
  args.step = 50;
  args.explicit_steps = 187;
  const auto fresh = blitzgs::cpu::adam_row(args, 0), stale = blitzgs::cpu::adam_row(args, 1);
  REQUIRE(fresh.decay1_to_params == 1);
  REQUIRE(fresh.decay2_to_target == Approx(std::pow(kBeta2, 20)).epsilon(1e-12));
  REQUIRE(stale.decay1_to_params == Approx(std::pow(kBeta1, 4)).epsilon(1e-12));
  REQUIRE(stale.decay1_to_target == Approx(std::pow(kBeta1, 10)).epsilon(1e-12));
  REQUIRE((fresh.moves && stale.moves));
  args.step = 400;
  REQUIRE_FALSE(blitzgs::cpu::adam_row(args, 2).moves);  // what is left of its drift is below rounding
}

TEST_CASE("rows that never had a gradient do not move, and groups split the SH column") {
  const Schedule schedule;
  REQUIRE(drift(schedule.args<double>(1e-15), 5, 100, 2, 0.0, 0.0) == 0);
  REQUIRE(blitzgs::adam_group(4, 2) == 4);
  REQUIRE(blitzgs::adam_group(4, 3) == 5);
  REQUIRE(blitzgs::adam_group(1, 3) == 1);
}
