// SPDX-License-Identifier: Apache-2.0
// The update of one row on the CPU, eight elements at a time, over the lane types of math/lanes.h. The
// arithmetic is that of adam_drift() and adam_update(). Compiled twice, plain and with AVX2.
#pragma once
#include <cstdint>

#include "adam/lazy_adam.h"
#include "math/lanes.h"

namespace blitzgs::cpu {

// The factors by which the moments of a row decay.
template <class T>
struct AdamRow {
  std::int32_t from;                     // the step of the parameters
  T decay1_to_params, decay2_to_params;  // beta1^k, beta2^k from the moments' step to `from`
  T decay1_to_target, decay2_to_target;  // beta1^k, beta2^k from the moments' step to the target
  bool moves;                            // see adam_moves
};

template <class T>
AdamRow<T> adam_row(const AdamArgs<T>& args, std::int64_t row) {
  const std::int32_t target = args.target();
  const std::int32_t from = args.last_step[row], moment_step = args.moment_step[row];
  const double *to_params = args.table_row(from - moment_step),
               *to_target = args.table_row(target - moment_step);
  return {from,
          static_cast<T>(to_params[kBeta1Power]),
          static_cast<T>(to_params[kBeta2Power]),
          static_cast<T>(to_target[kBeta1Power]),
          static_cast<T>(to_target[kBeta2Power]),
          adam_moves(args, from, moment_step)};
}

// The function for elements that take their pending steps one by one. They are rare, so plain code handles
// them.
template <class T>
using ExplicitDrift = T (*)(const AdamArgs<T>& args, const PendingSteps<T>& steps, int group, T m, T root);

template <class T>
struct AdamRowJob {
  const AdamArgs<T>& args;
  const AdamStep<T>& step;
  const AdamRow<T>& state;
  const PendingSteps<T>* steps;  // null unless the row moves
  ExplicitDrift<T> explicit_drift;
  std::int64_t row, list_row;
};

template <class T>
using AdamRowUpdate = void (*)(const AdamRowJob<T>& job);

// Defined in common/kernels_avx2.cpp; call only where the processor has AVX2 and FMA.
AdamRowUpdate<float> avx2_adam_row_update();

namespace {

// Returns value(group) for the learning-rate group of each lane. Groups ascend over the lanes.
template <class Lanes, class F>
Lanes by_group(const int* groups, const F& value) {
  if (groups[0] == groups[kLanes - 1]) return Lanes::broadcast(value(groups[0]));
  typename Lanes::Scalar values[kLanes];
  for (int i = 0; i < kLanes; ++i) values[i] = value(groups[i]);
  return Lanes::load(values);
}

// Returns the drift of eight elements; m and v are the moments at the step of the parameters.
template <class Lanes, class T>
Lanes drift_of(const AdamRowJob<T>& job, const int* groups, Lanes m, Lanes v) {
  const PendingSteps<T>& steps = *job.steps;
  const Lanes root = Lanes::sqrt(v), eps = Lanes::broadcast(static_cast<T>(job.args.eps));
  const auto moving = Lanes::greater(Lanes::abs(m), Lanes::zero());
  const auto ruled = moving & Lanes::greater(root, Lanes::broadcast(steps.explicit_up_to));
  Lanes parts[2];
  for (int i = 0; i < 2; ++i) {
    const Lanes place = by_group<Lanes>(groups, [&](int g) { return steps.rules[g].place[i]; });
    const Lanes weight = by_group<Lanes>(groups, [&](int g) { return steps.rules[g].weight[i]; });
    parts[i] = Lanes::broadcast(T(1)) / (place * root + eps) * weight;
  }
  Lanes drift = Lanes::keep(ruled, m * (parts[0] + parts[1]));
  if (unsigned bits = moving.and_not(ruled).bits()) {
    T ms[kLanes], roots[kLanes], each[kLanes];
    m.store(ms);
    root.store(roots);
    drift.store(each);
    for (int i = 0; i < kLanes; ++i) {
      if (bits >> i & 1) each[i] = job.explicit_drift(job.args, steps, groups[i], ms[i], roots[i]);
    }
    drift = Lanes::load(each);
  }
  return drift;
}

template <class Lanes, class T>
void take_step(const AdamStep<T>& s, const int* groups, Lanes g, Lanes& p, Lanes& m, Lanes& v) {
  m = Lanes::broadcast(s.beta1) * m + Lanes::broadcast(s.one_minus_beta1) * g;
  v = Lanes::broadcast(s.beta2) * v + Lanes::broadcast(s.one_minus_beta2) * (g * g);
  const Lanes root = Lanes::sqrt(v) * Lanes::broadcast(s.inverse_root2) + Lanes::broadcast(s.eps);
  p = p - by_group<Lanes>(groups, [&](int i) { return s.rate[i]; }) * m / root;
}

// Updates eight elements in place: catches up, then takes the step. g null: the parameters catch up only.
template <class Lanes, class T>
void update_elements(const AdamRowJob<T>& job, const int* groups, T* p, T* m, T* v, const T* g) {
  Lanes param = Lanes::load(p), first = Lanes::load(m), second = Lanes::load(v);
  const AdamRow<T>& state = job.state;
  if (job.steps) {
    param = param - drift_of<Lanes>(job, groups, first * Lanes::broadcast(state.decay1_to_params),
                                    second * Lanes::broadcast(state.decay2_to_params));
  }
  if (g) {
    first = first * Lanes::broadcast(state.decay1_to_target);
    second = second * Lanes::broadcast(state.decay2_to_target);
    take_step(job.step, groups, Lanes::load(g), param, first, second);
    first.store(m);
    second.store(v);
  }
  param.store(p);
}

// Collects elements of several short columns to fill the eight lanes, and updates them.
template <class Lanes, class T>
class AdamGather {
 public:
  explicit AdamGather(const AdamRowJob<T>& job) : job_(job) {}

  void add(int column, std::int64_t first, std::int64_t count) {
    const AdamColumn<T>& c = job_.args.columns[column];
    for (std::int64_t j = first; j < first + count; ++j) {
      const std::int64_t place = job_.row * c.width + j;
      from_[used_] = {c.param + place, c.exp_avg + place, c.exp_avg_sq + place};
      groups_[used_] = adam_group(column, j);
      g_[used_] = c.grad ? c.grad[job_.list_row * c.width + j] : T(0);
      if (++used_ == kLanes) flush();
    }
  }

  void flush() {
    if (used_ == 0) return;
    const bool step = job_.args.with_gradient();
    T p[kLanes] = {}, m[kLanes] = {}, v[kLanes] = {};
    for (int i = 0; i < used_; ++i) {
      p[i] = *from_[i].p;
      m[i] = *from_[i].m;
      v[i] = *from_[i].v;
    }
    for (int i = used_; i < kLanes; ++i) {
      g_[i] = T(0);
      groups_[i] = groups_[used_ - 1];
    }
    update_elements<Lanes>(job_, groups_, p, m, v, step ? g_ : nullptr);
    for (int i = 0; i < used_; ++i) {
      *from_[i].p = p[i];
      if (!step) continue;
      *from_[i].m = m[i];
      *from_[i].v = v[i];
    }
    used_ = 0;
  }

 private:
  struct Element {
    T *p, *m, *v;
  };
  const AdamRowJob<T>& job_;
  Element from_[kLanes];
  T g_[kLanes];
  int groups_[kLanes];
  int used_ = 0;
};

template <class Lanes, class T>
void update_row(const AdamRowJob<T>& job) {
  AdamGather<Lanes, T> gather(job);
  for (int column = 0; column < kAdamColumns; ++column) {
    const AdamColumn<T>& c = job.args.columns[column];
    const std::int64_t place = job.row * c.width, whole = c.width / kLanes * kLanes;
    for (std::int64_t j = 0; j < whole; j += kLanes) {
      int groups[kLanes];
      for (int i = 0; i < kLanes; ++i) groups[i] = adam_group(column, j + i);
      update_elements<Lanes>(job, groups, c.param + place + j, c.exp_avg + place + j,
                             c.exp_avg_sq + place + j,
                             c.grad ? c.grad + job.list_row * c.width + j : nullptr);
    }
    gather.add(column, whole, c.width - whole);
  }
  gather.flush();
}

}  // namespace
}  // namespace blitzgs::cpu
