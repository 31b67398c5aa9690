// SPDX-License-Identifier: Apache-2.0
// The update of one row on the CPU. The file is compiled twice, for the baseline and for AVX2. Both compile
// the same element-wise loops, so they give the same bits. Internal linkage keeps the two apart.
#pragma once
#include "adam/lazy_adam.h"

namespace blitzgs::cpu {

// The function for elements that take their pending steps one by one. They are rare: it is plain code.
template <class T>
using ExplicitDrift = T (*)(const AdamArgs<T>& args, const PendingSteps<T>& steps, int group, T m, T root);

template <class T> struct AdamRowJob {
  const AdamArgs<T>& args;
  const AdamStep<T>& step;
  const PendingSteps<T>* steps;  // null unless the row moves (adam_moves)
  ExplicitDrift<T> explicit_drift;
  int64_t row, list_row;
  const double *to_params, *to_target;  // rows of the table: the decay of the moments up to these steps
};

template <class T> using AdamRowUpdate = void (*)(const AdamRowJob<T>& job);

// Defined in common/kernels_avx2.cpp; call only where the processor has AVX2 and FMA.
AdamRowUpdate<float> avx2_adam_row_update();

namespace {

// Elements of one learning-rate group, in a row of a column.
template <class T> struct AdamElements {
  T *p, *m, *v;
  const T* g;  // null: the parameters catch up only
  int64_t n;
  int group;
};

// The arithmetic is that of adam_drift().
template <class T> void catch_up(const AdamRowJob<T>& job, const AdamElements<T>& e) {
  const PendingSteps<T>& steps = *job.steps;
  const AdamRule<T> rule = steps.rules[e.group];
  const T decay1 = T(job.to_params[kBeta1Power]), decay2 = T(job.to_params[kBeta2Power]);
  const T eps = T(job.args.eps), explicit_up_to = steps.explicit_up_to;
  int explicitly = 0;
#pragma GCC ivdep
  for (int64_t j = 0; j < e.n; ++j) {
    const T m = e.m[j] * decay1, root = std::sqrt(e.v[j] * decay2);
    const T drift = m * (T(1) / (rule.place[0] * root + eps) * rule.weight[0] +
                         T(1) / (rule.place[1] * root + eps) * rule.weight[1]);
    const bool moving = std::fabs(m) > T(0), ruled = root > explicit_up_to;
    e.p[j] -= moving && ruled ? drift : T(0);
    explicitly |= moving && !ruled;
  }
  for (int64_t j = 0; explicitly && j < e.n; ++j) {
    const T m = e.m[j] * decay1, root = std::sqrt(e.v[j] * decay2);
    if (std::fabs(m) > T(0) && !(root > explicit_up_to)) {
      e.p[j] -= job.explicit_drift(job.args, steps, e.group, m, root);
    }
  }
}

// The arithmetic is that of adam_update(), but for one rounding: it divides by the root.
template <class T> void take_step(const AdamRowJob<T>& job, const AdamElements<T>& e) {
  const AdamStep<T>& s = job.step;
  const T decay1 = T(job.to_target[kBeta1Power]), decay2 = T(job.to_target[kBeta2Power]);
  const T rate = s.rate[e.group];
#pragma GCC ivdep
  for (int64_t j = 0; j < e.n; ++j) {
    const T g = e.g[j];
    const T m = s.beta1 * (e.m[j] * decay1) + s.one_minus_beta1 * g;
    const T v = s.beta2 * (e.v[j] * decay2) + s.one_minus_beta2 * (g * g);
    e.p[j] -= rate * m / (std::sqrt(v) * s.inverse_root2 + s.eps);
    e.m[j] = m;
    e.v[j] = v;
  }
}

template <class T> void update_row(const AdamRowJob<T>& job) {
  for (int column = 0; column < kAdamColumns; ++column) {
    const AdamColumn<T>& c = job.args.columns[column];
    for (int64_t first = 0, end; first < c.width; first = end) {
      const int group = adam_group(column, first);
      end = group == kAdamGroups - 2 && c.width > 3 ? 3 : c.width;  // the SH column has two groups
      const int64_t at = job.row * c.width + first;
      const AdamElements<T> elements{
          c.param + at,      c.exp_avg + at,
          c.exp_avg_sq + at, c.grad ? c.grad + job.list_row * c.width + first : nullptr,
          end - first,       group};
      if (job.steps) catch_up(job, elements);
      if (elements.g) take_step(job, elements);
    }
  }
}

}  // namespace
}  // namespace blitzgs::cpu
