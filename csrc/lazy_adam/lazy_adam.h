// SPDX-License-Identifier: Apache-2.0
// Dense Adam over an index list: a row that had no gradient for k steps is brought up to date when it is
// next needed, in time that does not depend on k.
//
// Dense Adam (Kingma & Ba 2015), step t, gradient g:
//   m = beta1 m + (1 - beta1) g     v = beta2 v + (1 - beta2) g^2
//   p -= lr_t (m / (1 - beta1^t)) / (sqrt(v) / sqrt(1 - beta2^t) + eps)
// Without a gradient over the steps L+1 .. s the moments only decay, m beta1^k and v beta2^k with k = s - L,
// and while eps is below the rounding of sqrt(v) the parameter drifts by m / sqrt(v) times
//   sum over t = L+1 .. s of lr_t r^(t-L) c_t = tail[L] - r^(s-L) tail[s],
//   r = beta1 / sqrt(beta2),  c_t = sqrt(1 - beta2^t) / (1 - beta1^t),  tail[L] = r (lr_{L+1} c_{L+1} +
//   tail[L+1]),
// one number per row and parameter group, read from a table made once per schedule. Elements for which eps
// matters take the zero-gradient steps one by one, at most `explicit_steps` of them: after those, r^j is
// below the rounding of the sum.
//
// Table [S+1, 11], double, row t (S is the last step of the schedule):
//   0..5   tail[t] of means, quats, scales, opacities, SH DC, SH rest
//   6..8   beta1^t, beta2^t, r^t
//   9, 10  1 / (1 - beta1^t), 1 / sqrt(1 - beta2^t)   (row 0: 0)
//
// Rows are independent and each element is computed the same way wherever it lies, so results do not depend
// on the order of the list or on sharding. O(1) per element.
#pragma once
#include <cmath>
#include <cstdint>

#include "common/host_device.h"
#include "common/stream.h"

namespace blitzgs {

constexpr int kAdamColumns = 5;  // means, quats, scales, opacities, sh
constexpr int kAdamGroups = 6;   // learning rates: the SH column has two
constexpr int kAdamTable = 11;

template <class T>
struct AdamColumn {
  T* param;
  T* exp_avg;
  T* exp_avg_sq;
  const T* grad;  // [n, width], row of the list; null when catching up only
  std::int64_t width;
};

template <class T>
struct AdamArgs {
  AdamColumn<T> columns[kAdamColumns];
  const std::int32_t* ids;  // [n] rows, unique; null = row i is i
  std::int64_t n;
  std::int32_t* last_step;  // [N]
  const double* table;      // [S+1, 11]
  const float* lr_table;    // [S+1, 6]
  std::int32_t step;
  std::int32_t explicit_steps;
  double beta1, beta2, eps;
  bool sparse;  // plain sparse Adam: no decay, no drift
};

// What is owed by one row whose state stands at step `from` and shall stand at step `to`.
template <class T>
struct AdamDebt {
  std::int32_t from, to;
  T decay1, decay2;  // beta1^k, beta2^k
  T negligible;      // sqrt(v) above this: eps is lost in rounding over the whole gap
  T drift[kAdamGroups];
};

template <class T>
BLITZGS_HD AdamDebt<T> adam_debt(const AdamArgs<T>& args, std::int32_t from, std::int32_t to) {
  AdamDebt<T> debt{};
  debt.from = from;
  debt.to = to;
  if (from >= to) return debt;
  const std::int32_t k = to - from;
  const double* begin = args.table + static_cast<std::int64_t>(from) * kAdamTable;
  const double* end = args.table + static_cast<std::int64_t>(to) * kAdamTable;
  const double* power = args.table + static_cast<std::int64_t>(k) * kAdamTable;
  debt.decay1 = static_cast<T>(power[6]);
  debt.decay2 = static_cast<T>(power[7]);
  const std::int32_t reach = k < args.explicit_steps ? k : args.explicit_steps;
  const double rounding = sizeof(T) == 4 ? 5.9e-8 : 1.1e-16;
  // sqrt(v beta2^reach) / sqrt(1 - beta2^t) is smallest at the end of the gap or later, where 1 - beta2^t
  // < 1.
  debt.negligible =
      static_cast<T>(args.eps / (rounding * std::sqrt(args.table[std::int64_t{reach} * kAdamTable + 7])));
  for (int g = 0; g < kAdamGroups; ++g) debt.drift[g] = static_cast<T>(begin[g] - power[8] * end[g]);
  return debt;
}

// The zero-gradient steps of one element, one by one.
template <class T>
BLITZGS_HD T adam_explicit_drift(const AdamArgs<T>& args, const AdamDebt<T>& debt, int group, T m, T v) {
  const T beta1 = static_cast<T>(args.beta1), root_beta2 = static_cast<T>(std::sqrt(args.beta2));
  const T eps = static_cast<T>(args.eps);
  const std::int32_t last =
      debt.to - debt.from < args.explicit_steps ? debt.to : debt.from + args.explicit_steps;
  T root = std::sqrt(v), drift = 0;
  for (std::int32_t t = debt.from + 1; t <= last; ++t) {
    const double* row = args.table + static_cast<std::int64_t>(t) * kAdamTable;
    m *= beta1;
    root *= root_beta2;
    drift += args.lr_table[static_cast<std::int64_t>(t) * kAdamGroups + group] *
             (m * static_cast<T>(row[9])) / (root * static_cast<T>(row[10]) + eps);
  }
  return drift;
}

template <class T>
BLITZGS_HD void adam_catch_up(const AdamArgs<T>& args, const AdamDebt<T>& debt, int group, T& p, T& m, T& v) {
  if (m != 0) {
    const T root = std::sqrt(v);
    p -= root > debt.negligible ? m / root * debt.drift[group] : adam_explicit_drift(args, debt, group, m, v);
  }
  m *= debt.decay1;
  v *= debt.decay2;
}

// The scalars of one step with a gradient.
template <class T>
struct AdamStep {
  T beta1, one_minus_beta1, beta2, one_minus_beta2, inverse_root2, eps;
  T rate[kAdamGroups];  // lr_t / (1 - beta1^t)
};

template <class T>
BLITZGS_HD AdamStep<T> adam_step_scalars(const AdamArgs<T>& args) {
  const double* row = args.table + static_cast<std::int64_t>(args.step) * kAdamTable;
  AdamStep<T> s;
  s.beta1 = static_cast<T>(args.beta1);
  s.one_minus_beta1 = static_cast<T>(1.0 - args.beta1);
  s.beta2 = static_cast<T>(args.beta2);
  s.one_minus_beta2 = static_cast<T>(1.0 - args.beta2);
  s.inverse_root2 = static_cast<T>(row[10]);
  s.eps = static_cast<T>(args.eps);
  for (int g = 0; g < kAdamGroups; ++g) {
    s.rate[g] =
        static_cast<T>(args.lr_table[static_cast<std::int64_t>(args.step) * kAdamGroups + g] * row[9]);
  }
  return s;
}

template <class T>
BLITZGS_HD void adam_update(const AdamStep<T>& s, int group, T g, T& p, T& m, T& v) {
  m = s.beta1 * m + s.one_minus_beta1 * g;
  v = s.beta2 * v + s.one_minus_beta2 * (g * g);
  p -= s.rate[group] * m / (std::sqrt(v) * s.inverse_root2 + s.eps);
}

// The learning-rate group of element j of a column.
BLITZGS_HD int adam_group(int column, std::int64_t element) {
  return column == 4 && element >= 3 ? 5 : column;
}

namespace cpu {
// With gradients: rows behind step - 1 are caught up, then step `step` is taken. Without (column.grad null):
// rows behind `step` are caught up. last_step of the rows becomes `step`.
template <class T>
void lazy_adam(const AdamArgs<T>& args, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
template <class T>
void lazy_adam(const AdamArgs<T>& args, Workspace&, CudaStream);
}

}  // namespace blitzgs
