// SPDX-License-Identifier: Apache-2.0
// The update of one row, eight elements at a time, over the lane types of math/lanes.h: operation for
// operation what adam_catch_up() and adam_update() do, hence the same bits. Compiled plain and with AVX2.
#pragma once
#include <cstdint>

#include "lazy_adam/lazy_adam.h"
#include "math/lanes.h"

namespace blitzgs::cpu {

// The elements for which eps matters while they catch up; rare, and left to plain code.
template <class T>
using ExplicitDrift = T (*)(const AdamArgs<T>& args, const AdamDebt<T>& debt, int group, T m, T v);

template <class T>
struct AdamRowJob {
  const AdamArgs<T>& args;
  const AdamStep<T>& step;
  const AdamDebt<T>& debt;
  ExplicitDrift<T> explicit_drift;
  std::int64_t row, list_row;
};

template <class T>
using AdamRowUpdate = void (*)(const AdamRowJob<T>& job);

// Defined in lazy_adam_avx2.cpp; call only where the processor has AVX2 and FMA.
AdamRowUpdate<float> avx2_adam_row_update();

namespace {

// Eight elements and what differs between their learning-rate groups.
template <class Lanes>
struct AdamElements {
  Lanes p, m, v, drift, rate;
};

template <class Lanes, class T>
void catch_up(const AdamRowJob<T>& job, const int* groups, AdamElements<Lanes>& x) {
  const Lanes zero = Lanes::zero(), root = Lanes::sqrt(x.v);
  const auto moving = Lanes::greater(Lanes::abs(x.m), zero);
  const auto simple = moving & Lanes::greater(root, Lanes::broadcast(job.debt.negligible));
  Lanes drift = Lanes::keep(simple, x.m / root * x.drift);
  if (unsigned bits = moving.and_not(simple).bits()) {
    T m[kLanes], v[kLanes], each[kLanes];
    x.m.store(m);
    x.v.store(v);
    drift.store(each);
    for (int i = 0; i < kLanes; ++i) {
      if (bits >> i & 1) each[i] = job.explicit_drift(job.args, job.debt, groups[i], m[i], v[i]);
    }
    drift = Lanes::load(each);
  }
  x.p = x.p - drift;
  x.m = x.m * Lanes::broadcast(job.debt.decay1);
  x.v = x.v * Lanes::broadcast(job.debt.decay2);
}

template <class Lanes, class T>
void take_step(const AdamStep<T>& s, Lanes g, AdamElements<Lanes>& x) {
  x.m = Lanes::broadcast(s.beta1) * x.m + Lanes::broadcast(s.one_minus_beta1) * g;
  x.v = Lanes::broadcast(s.beta2) * x.v + Lanes::broadcast(s.one_minus_beta2) * (g * g);
  const Lanes root = Lanes::sqrt(x.v) * Lanes::broadcast(s.inverse_root2) + Lanes::broadcast(s.eps);
  x.p = x.p - x.rate * x.m / root;
}

// Updates eight elements in place; g null: catch up only.
template <class Lanes, class T>
void update_elements(const AdamRowJob<T>& job, const int* groups, T* p, T* m, T* v, const T* g) {
  T drift[kLanes], rate[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    drift[i] = job.debt.drift[groups[i]];
    rate[i] = job.step.rate[groups[i]];
  }
  AdamElements<Lanes> x{Lanes::load(p), Lanes::load(m), Lanes::load(v), Lanes::load(drift),
                        Lanes::load(rate)};
  if (job.debt.from < job.debt.to) catch_up(job, groups, x);
  if (g) take_step(job.step, Lanes::load(g), x);
  x.p.store(p);
  x.m.store(m);
  x.v.store(v);
}

// Elements of several short columns, gathered to fill the lanes.
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
    T p[kLanes] = {}, m[kLanes] = {}, v[kLanes] = {};
    for (int i = 0; i < used_; ++i) {
      p[i] = *from_[i].p;
      m[i] = *from_[i].m;
      v[i] = *from_[i].v;
    }
    for (int i = used_; i < kLanes; ++i) {
      g_[i] = T(0);
      groups_[i] = 0;
    }
    update_elements<Lanes>(job_, groups_, p, m, v, job_.args.columns[0].grad ? g_ : nullptr);
    for (int i = 0; i < used_; ++i) {
      *from_[i].p = p[i];
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
