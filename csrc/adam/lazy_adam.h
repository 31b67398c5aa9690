// SPDX-License-Identifier: Apache-2.0
// The lazy optimiser: dense Adam (Kingma & Ba 2015) over a list of rows. A row that had no gradient for k
// steps has k pending steps. It catches up (takes its pending steps) when it is needed next, in time that
// does not depend on k. Step t with gradient g:
//   m = beta1 m + (1 - beta1) g,   v = beta2 v + (1 - beta2) g^2,
//   p -= lr_t b_t m / (a_t sqrt(v) + eps),   b_t = 1 / (1 - beta1^t),   a_t = 1 / sqrt(1 - beta2^t).
//
// Without a gradient the moments only decay: if they are m and v at step P, they are m beta1^j and v beta2^j
// at step t = P + j. From step P to step s the parameter therefore drifts by
//   m sum over j = 1 .. s - P of mu_j rho_j / (rho_j sqrt(v) + eps),
//   rho_j = a_t beta2^(j/2),   mu_j = lr_t b_t / a_t q_0^j,   q_0 = beta1 / sqrt(beta2).
// rho_j changes far more slowly than mu_j falls. The code therefore computes the sum by a two-point Gauss
// rule in rho with the weights mu, whose places and weights reproduce the sums
//   sum over j of mu_j rho_j^k = tail_k[P] - q_k^(s-P) tail_k[s],   k = 0 .. 3,
// where the tails are tabulated once per schedule (see the table below).
//
// The rule is exact if eps is negligible against sqrt(v) (then only k = 0 counts) and if eps dominates
// (k = 1). In between its relative error is largest near eps = 3 sqrt(v), and below half the square of rho's
// relative variance: 1e-9 of the drift in the middle of a schedule, and below the rounding of float32 after
// some 200 steps of one view. Where this is not exact enough (earlier, and in float64), the elements for
// which eps matters take the pending steps one by one, at most `explicit_steps` of them: q_0^j is below the
// rounding of the sum after that. So the drift of a row with at least that many pending steps depends only on
// the step at which its parameters are: its rule is tabulated (final_rules), and the rules that a launch has
// to compute do not become more with the number of steps.
//
// Two columns hold the state of a row: its parameters are those after step `last_step`, and its moments are
// those after step `moment_step` <= last_step. Catching up reads the moments but does not write them; the
// next step with a gradient applies their decay.
//
// Rows are independent, and each element is computed in the same way wherever it is, so the results depend
// neither on the order of the list nor on sharding. The cost is O(1) per element.
#pragma once
#include "math/vec.h"

// Columns of the table of a learning-rate schedule, double [S + 1, 30], made once in Python
// (blitzgs/ops/lazy_adam.py). S is the last step; row t holds, with q_k = beta1 beta2^((k - 1) / 2) and a_t
// and b_t as above (row 0: 0), for the groups g = means, quats, scales, opacities, SH DC, SH rest and the
// orders k = 0 .. 3
//   tail_k[t] = sum over u = t + 1 .. S of lr_u b_u a_u^(k - 1) q_k^(u - t).

namespace blitzgs {

constexpr int kAdamGroups = 6;  // learning rates: the SH column has two
constexpr int kAdamOrders = 4;

constexpr int kTails = 0;         // + 6 k + g
constexpr int kBeta1Power = 24;   // beta1^t
constexpr int kBeta2Power = 25;   // beta2^t
constexpr int kRatioPower = 26;   // q_0^t
constexpr int kRootPower = 27;    // beta2^(t/2)
constexpr int kCorrection1 = 28;  // b_t
constexpr int kCorrection2 = 29;  // a_t
constexpr int kAdamTable = 30;

constexpr int kAdamColumns = 5;  // means, quats, scales, opacities, sh

template <class T> struct AdamColumn {
  T *param, *exp_avg, *exp_avg_sq;
  const T* grad;  // [n, width], one row for each row of the list; null if rows only catch up
  int64_t width;
};

// The Gauss rule of one group: drift = m * (sum over both points of weight / (place sqrt(v) + eps)).
template <class T> struct alignas(4 * sizeof(T)) AdamRule {
  T place[2], weight[2];
};

// The rules of the drift of rows whose parameters are at step `from` and catch up to step `to`.
template <class T> struct PendingSteps {
  AdamRule<T> rules[kAdamGroups];
  int32_t from, to;
  T explicit_up_to;  // elements with sqrt(v) <= this take the steps one by one; negative: none
};

// Tables of a schedule of a single parameter, which is in the SH column, whose learning rates become known
// step by step. The term of a step goes to the tails of the explicit_steps rows before it; earlier rows need
// none, because moments of that age have decayed below rounding.
struct RatesArgs {
  double* table;
  float* lr_table;
  int32_t step, explicit_steps;  // step 0: no learning rates to enter
  double ratio, root;            // q_0 and sqrt(beta2)
  float rates[2];                // learning rates of SH DC and SH rest

  BLITZGS_HD int32_t reach() const { return step < explicit_steps ? step : explicit_steps; }
  BLITZGS_HD double ratio_of(int order) const { return ratio * std::pow(root, order); }
};

template <class T> struct AdamArgs {
  AdamColumn<T> columns[kAdamColumns];
  const int32_t* ids;       // [n], the rows, each once; null: those of long_ids
  const int64_t* long_ids;  // [n]; null: all n rows
  int64_t n;
  // CUDA, catching up: the number of valid ids in device memory; null: all n
  const int32_t* count;
  int32_t *last_step, *moment_step;    // [N]
  const double* table;                 // [S+1, kAdamTable]
  const float* lr_table;               // [S+1, 6]
  const PendingSteps<T>* final_rules;  // [final_rules_of(S + 1, explicit_steps)]; null: not tabulated
  int32_t step;
  int32_t explicit_steps;
  double beta1, beta2, eps;
  bool current;     // the parameters of the listed rows stand at target(), so that none has to catch up
  RatesArgs rates;  // of `step`; they enter the tables

  // Tests the SH column, because the other columns may be empty.
  BLITZGS_HD bool with_gradient() const { return columns[kAdamColumns - 1].grad != nullptr; }
  // The step to which the listed rows catch up: `step`, or the step before it if a gradient step follows.
  BLITZGS_HD int32_t target() const { return with_gradient() ? step - 1 : step; }
  BLITZGS_HD int64_t row(int64_t i) const { return ids ? ids[i] : long_ids ? long_ids[i] : i; }
  BLITZGS_HD const double* table_row(int32_t t) const { return table + int64_t(t) * kAdamTable; }
};

// The number of final rules: the steps 0 .. n - 1 from which `explicit_steps` steps remain in the table.
BLITZGS_HD int64_t final_rules_of(int64_t table_rows, int64_t explicit_steps) {
  return table_rows > explicit_steps ? table_rows - explicit_steps : 0;
}

// Returns the rule of a group from step `from` to step `to`, and raises `error` to the bound of its relative
// error if that is larger. If to - from >= explicit_steps, the rule does not depend on `to`.
template <class T>
BLITZGS_HD AdamRule<T> adam_rule(const AdamArgs<T>& args, int32_t from, int32_t to, int group,
                                 double& error) {
  const double* begin = args.table_row(from) + kTails + group;
  double moments[kAdamOrders];
  for (int k = 0; k < kAdamOrders; ++k) moments[k] = begin[k * kAdamGroups];
  if (to - from < args.explicit_steps) {
    const double *end = args.table_row(to) + kTails + group, *power = args.table_row(to - from);
    double q = power[kRatioPower];
    for (int k = 0; k < kAdamOrders; ++k, q *= power[kRootPower]) moments[k] -= q * end[k * kAdamGroups];
  }
  const double total = moments[0];
  if (!(total > 0)) return {{T(1), T(1)}, {T(0), T(0)}};  // the learning rates are zero
  const double mean = moments[1] / total, square = moments[2] / total, cube = moments[3] / total;
  const double variance = square - mean * mean, share = variance / (mean * mean);
  // A single step, or steps whose rho are equal to the precision of double.
  if (!(share > 1e-10)) return {{T(mean), T(1)}, {T(total * mean), T(0)}};
  const double skew = (cube - 3 * mean * square + 2 * mean * mean * mean) / (2 * variance);
  const double spread = std::sqrt(skew * skew + variance), above = skew + spread, below = skew - spread;
  const double places[2] = {mean + above, mean + below};
  const double weights[2] = {total * (-below / (2 * spread)), total * (above / (2 * spread))};
  error = error > 0.5 * share * share ? error : 0.5 * share * share;
  return {{T(places[0]), T(places[1])}, {T(weights[0] * places[0]), T(weights[1] * places[1])}};
}

// Returns explicit_up_to for rules whose relative errors are at most `error`.
template <class T>
BLITZGS_HD T adam_explicit_up_to(const AdamArgs<T>& args, int32_t from, int32_t to, double error) {
  const double rounding = sizeof(T) == 4 ? 5.9e-8 : 1.1e-16;
  if (!(error > 2 * rounding)) return T(-1);
  // For sqrt(v) above the returned value, eps is below the rounding of the smallest place * sqrt(v):
  // a_t >= 1, and steps after explicit_steps contribute nothing.
  const int32_t gap = to - from, reach = gap < args.explicit_steps ? gap : args.explicit_steps;
  return T(args.eps / (rounding * args.table_row(reach)[kRootPower]));
}

template <class T>
BLITZGS_HD PendingSteps<T> pending_steps(const AdamArgs<T>& args, int32_t from, int32_t to) {
  PendingSteps<T> steps;
  steps.from = from;
  steps.to = to;
  double error = 0;
  for (int g = 0; g < kAdamGroups; ++g) steps.rules[g] = adam_rule(args, from, to, g, error);
  steps.explicit_up_to = adam_explicit_up_to(args, from, to, error);
  return steps;
}

// Row `from`: the pending steps of a row of the table at this step that is behind by explicit_steps or more.
// Reads the table, explicit_steps and eps of args.
template <class T> struct FinalRules {
  AdamArgs<T> args;
  PendingSteps<T>* rules;  // [n]
  int64_t n;

  BLITZGS_HD void operator()(int64_t i) const {
    const auto from = int32_t(i);
    rules[i] = pending_steps(args, from, from + args.explicit_steps);
  }
};

// The drift of one element by its pending steps, one by one; m and root = sqrt(v) at steps.from.
template <class T>
BLITZGS_HD T adam_explicit_drift(const AdamArgs<T>& args, const PendingSteps<T>& steps, int group, T m,
                                 T root) {
  const T beta1 = T(args.beta1), root_beta2 = T(std::sqrt(args.beta2));
  const T eps = T(args.eps);
  const int32_t last =
      steps.to - steps.from < args.explicit_steps ? steps.to : steps.from + args.explicit_steps;
  T drift = 0;
  for (int32_t t = steps.from + 1; t <= last; ++t) {
    const double* row = args.table_row(t);
    m *= beta1;
    root *= root_beta2;
    drift += T(args.lr_table[int64_t(t) * kAdamGroups + group]) * (m * T(row[kCorrection1])) /
             (root * T(row[kCorrection2]) + eps);
  }
  return drift;
}

// The square root. On CUDA it is exact to an ulp, as the reciprocal: correct rounding would take most of an
// update's instructions, and the ulp is below the update's own rounding.
template <class T> BLITZGS_HD T adam_root(T x) {
#ifdef __CUDA_ARCH__
  if constexpr (sizeof(T) == 4) {
    asm("sqrt.approx.f32 %0, %0;" : "+f"(x));
    return x;
  }
#endif
  return std::sqrt(x);
}

// The drift of one element by its group's rule; m and root = sqrt(v) are those at the rule's first step.
template <class T> BLITZGS_HD T adam_ruled_drift(const AdamRule<T>& rule, T m, T root, T eps) {
  const T drift = m * (reciprocal(rule.place[0] * root + eps) * rule.weight[0] +
                       reciprocal(rule.place[1] * root + eps) * rule.weight[1]);
  return m == 0 ? T(0) : drift;
}

// The amount to subtract from a parameter when it catches up; m and v are the moments at step steps.from.
template <class T>
BLITZGS_HD T adam_drift(const AdamArgs<T>& args, const PendingSteps<T>& steps, int group, T m, T v) {
  const T root = adam_root(v);
  if (m == 0) return 0;
  if (!(root > steps.explicit_up_to)) return adam_explicit_drift(args, steps, group, m, root);
  return adam_ruled_drift(steps.rules[group], m, root, T(args.eps));
}

// Whether the drift of a row on its way to the target is above rounding. `moment_step` is the step of its
// moments; the drift from explicit_steps after that step on is below rounding.
template <class T> BLITZGS_HD bool adam_moves(const AdamArgs<T>& args, int32_t from, int32_t moment_step) {
  return from < args.target() && from - moment_step < args.explicit_steps;
}

template <class T> struct AdamStep {
  T beta1, one_minus_beta1, beta2, one_minus_beta2, inverse_root2, eps;
  T rate[kAdamGroups];  // lr_t b_t
};

template <class T> BLITZGS_HD AdamStep<T> adam_step_scalars(const AdamArgs<T>& args) {
  const double* row = args.table_row(args.step);
  AdamStep<T> s;
  s.beta1 = T(args.beta1);
  s.one_minus_beta1 = T(1.0 - args.beta1);
  s.beta2 = T(args.beta2);
  s.one_minus_beta2 = T(1.0 - args.beta2);
  s.inverse_root2 = T(row[kCorrection2]);
  s.eps = T(args.eps);
  const float* rates = args.lr_table + int64_t(args.step) * kAdamGroups;
  for (int g = 0; g < kAdamGroups; ++g) {
    const float rate = args.rates.step == 0 ? rates[g] : args.rates.rates[g == kAdamGroups - 1];
    s.rate[g] = T(rate * row[kCorrection1]);
  }
  return s;
}

// One Adam step of one element: parameter p, moments m and v, gradient g.
template <class T> BLITZGS_HD void adam_update(const AdamStep<T>& s, int group, T g, T& p, T& m, T& v) {
  m = s.beta1 * m + s.one_minus_beta1 * g;
  v = s.beta2 * v + s.one_minus_beta2 * (g * g);
  p -= s.rate[group] * m * reciprocal(adam_root(v) * s.inverse_root2 + s.eps);
}

// The learning-rate group of element j of a column; groups ascend within a column and over the columns.
BLITZGS_HD int adam_group(int column, int64_t element) { return column == 4 && element >= 3 ? 5 : column; }

// Adds the term of a step to the tails of an order in the row `back` before it; power = ratio_of(order)^back.
// The row before the step also notes the step's learning rates.
BLITZGS_HD void enter_rate(const RatesArgs& args, int32_t back, int order, double power) {
  const double* own = args.table + int64_t(args.step) * kAdamTable;
  const double a = own[kCorrection2];
  const double share = own[kCorrection1] *
                       (order == 0   ? 1 / a
                        : order == 1 ? 1
                        : order == 2 ? a
                                     : a * a) *
                       power;
  constexpr int kDc = kAdamGroups - 2;
  double* tails = args.table + int64_t(args.step - back) * kAdamTable + kTails + order * kAdamGroups + kDc;
  float* rates = args.lr_table + int64_t(args.step) * kAdamGroups + kDc;
  for (int part = 0; part < 2; ++part) {
    tails[part] += args.rates[part] * share;
    if (back == 1 && order == 0) rates[part] = args.rates[part];
  }
}

namespace BLITZGS_BACKEND {
// With gradients: the listed rows catch up to step - 1 and take the step `step`; parameters and moments are
// then at `step`. Without (column.grad null), their parameters catch up to `step`.
template <class T> void lazy_adam(const AdamArgs<T>& args, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
