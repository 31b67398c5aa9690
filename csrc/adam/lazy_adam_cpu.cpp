// SPDX-License-Identifier: Apache-2.0
#include "adam/lazy_adam.h"
#include "adam/lazy_adam_row.h"
#include "common/parallel.h"

namespace blitzgs::cpu {
namespace {

template <class T> AdamRowUpdate<T> row_update() {
  if constexpr (std::is_same_v<T, float>) {
    if (use_avx2()) return avx2_adam_row_update();
  }
  return update_row<T>;
}

// The rows of a list are scattered in memory, so a row is prefetched while those before are updated.
constexpr int64_t kPrefetchDistance = 3;

template <class T> void prefetch_row(const AdamArgs<T>& args, int64_t row) {
  constexpr int64_t kLine = 64 / sizeof(T);
  asm volatile("");  // without this, gcc drops calls of a function that only prefetches
  for (const AdamColumn<T>& column : args.columns) {
    for (T* start : {column.param, column.exp_avg, column.exp_avg_sq}) {
      for (int64_t j = 0; j < column.width; j += kLine) __builtin_prefetch(start + row * column.width + j, 1);
    }
  }
}

// Among rows with pending steps few different values of last_step occur, so each thread computes the rules
// once for many rows.
template <class T> class PendingStepsCache {
 public:
  const PendingSteps<T>& get(const AdamArgs<T>& args, int32_t from, int32_t to) {
    if (args.final_rules && to - from >= args.explicit_steps) return args.final_rules[from];
    PendingSteps<T>& steps = cached_[from % kSlots];
    if (!used_[from % kSlots] || steps.from != from) {
      steps = pending_steps(args, from, to);
      used_[from % kSlots] = true;
    }
    return steps;
  }

 private:
  static constexpr int kSlots = 64;
  PendingSteps<T> cached_[kSlots];
  bool used_[kSlots] = {};
};

}  // namespace

template <class T> void lazy_adam(const AdamArgs<T>& args, Workspace&, CudaStream) {
  const bool with_gradient = args.with_gradient();
  const AdamStep<T> step = adam_step_scalars(args);
  const AdamRowUpdate<T> update = row_update<T>();
  const int32_t target = args.target();
  parallel_for(0, args.n, 512, [&](int64_t begin, int64_t end) {
    PendingStepsCache<T> pending;
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = args.row(i);
      prefetch_row(args, args.row(std::min(i + kPrefetchDistance, end - 1)));
      const int32_t from = args.last_step[row], stand = args.moment_step[row];
      if (!with_gradient && from >= target) continue;
      const PendingSteps<T>* steps =
          adam_moves(args, from, stand) ? &pending.get(args, from, target) : nullptr;
      if (with_gradient || steps) {
        update({args, step, steps, adam_explicit_drift<T>, row, i, args.table_row(from - stand),
                args.table_row(target - stand)});
      }
      args.last_step[row] = args.step;
      if (with_gradient) args.moment_step[row] = args.step;
    }
  });
  for (int order = 0; order < kAdamOrders; ++order) {
    const double ratio = args.rates.ratio_of(order);
    double power = 1;
    for (int32_t back = 1; back <= args.rates.reach(); ++back) {
      enter_rate(args.rates, back, order, power *= ratio);
    }
  }
}

BLITZGS_FOR_BOTH_DTYPES(lazy_adam);

}  // namespace blitzgs::cpu
