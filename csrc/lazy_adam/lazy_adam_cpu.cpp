// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "lazy_adam/lazy_adam.h"

namespace blitzgs::cpu {

namespace {

template <class T>
void update_row(const AdamArgs<T>& args, const AdamStep<T>& step, const AdamDebt<T>& debt, std::int64_t row,
                std::int64_t list_row) {
  const bool owing = debt.from < debt.to;
  for (int c = 0; c < kAdamColumns; ++c) {
    const AdamColumn<T>& column = args.columns[c];
    T* p = column.param + row * column.width;
    T* m = column.exp_avg + row * column.width;
    T* v = column.exp_avg_sq + row * column.width;
    if (owing) {
      for (std::int64_t j = 0; j < column.width; ++j) {
        adam_catch_up(args, debt, adam_group(c, j), p[j], m[j], v[j]);
      }
    }
    if (!column.grad) continue;
    const T* g = column.grad + list_row * column.width;
    for (std::int64_t j = 0; j < column.width; ++j)
      adam_update(step, adam_group(c, j), g[j], p[j], m[j], v[j]);
  }
}

}  // namespace

template <class T>
void lazy_adam(const AdamArgs<T>& args, Workspace&, CudaStream) {
  const bool with_gradient = args.columns[0].grad != nullptr;
  const AdamStep<T> step = adam_step_scalars(args);
  const std::int32_t target = with_gradient ? args.step - 1 : args.step;
  parallel_for(0, args.n, 512, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t row = args.ids ? args.ids[i] : i;
      const std::int32_t from = args.sparse ? target : args.last_step[row];
      if (!with_gradient && from >= target) continue;
      update_row(args, step, adam_debt(args, from, target), row, i);
      args.last_step[row] = args.step;
    }
  });
}

template void lazy_adam<float>(const AdamArgs<float>&, Workspace&, CudaStream);
template void lazy_adam<double>(const AdamArgs<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
