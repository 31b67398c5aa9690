// SPDX-License-Identifier: Apache-2.0
#include "adam/lazy_adam_op.h"

#include "adam/position_noise.h"
#include "adam/scale_limit.h"

namespace blitzgs {
namespace {

// Takes the step for the rows `ids`, int32 or int64 [A], or for all rows, from a gradient [A, ...] for each
// column. current: the parameters of the rows stand at step - 1. rates: empty, or the learning rates of the
// step, of the first three values of SH and of all others, which enter the tables (`RatesArgs`).
void lazy_adam_step(const TensorList& state_in, const TensorList& tables, int64_t step,
                    int64_t explicit_steps, double beta1, double beta2, double eps, const TensorList& grads,
                    const OptionalTensor& ids, bool current, const FloatList& rates,
                    const OptionalTensor& taken) {
  AdamTensors state(state_in, tables, {step, explicit_steps, beta1, beta2, eps});
  float* taken_steps = taken ? checked_in_place<float>("taken", *taken, {}).data() : nullptr;
  BLITZGS_CHECK(!taken || taken->is_cpu(), "taken must be on the CPU");
  BLITZGS_CHECK(std::ssize(grads) == state.count(), "grads must hold ",
                state.alone ? "one" : "means, quats, scales, opacities, sh", "; got ", grads.size(),
                " tensors");
  BLITZGS_CHECK(rates.empty() || (rates.size() == 2 && state.alone && !state.final_rules),
                "rates must be empty or two numbers, for one parameter and tables without final_rules");
  state.check_takes_step();
  const OptionalTensor list = state.checked_rows(ids);
  const int64_t n = list ? list->numel() : state.rows();
  TensorList held;
  for (int c = 0; c < state.count(); ++c) {
    const Tensor& grad = held.emplace_back(as_contiguous(grads[c]));
    check_dtype("grads", grad, state.like().scalar_type());
    BLITZGS_CHECK(grad.dim() >= 1 && grad.size(0) == n && grad.numel() == n * state.width(c),
                  "the gradient of ", state.name(c), " must have ", n, " rows of ", state.width(c),
                  " values, got ", shape_of(grad));
  }
  DeviceScope scope(state.like());
  dispatch_floating(state.like(), [&]<class T>() {
    AdamArgs<T> args = state.arguments<T>(list);
    for (int c = 0; c < state.count(); ++c) args.columns[state.first() + c].grad = data<T>(held[c]);
    args.current = current;
    if (!rates.empty()) {
      const double root = std::sqrt(beta2);
      args.rates = {mutable_data<double>(state.table),
                    mutable_data<float>(state.lr_table),
                    args.step,
                    args.explicit_steps,
                    beta1 / root,
                    root,
                    {float(rates[0]), float(rates[1])}};
    }
    if (n > 0 || !rates.empty()) backend::lazy_adam(args, scope.workspace, scope.stream);
  });
  if (taken_steps) ++*taken_steps;
}

void lazy_adam_catch_up(const TensorList& state_in, const TensorList& tables, int64_t step,
                        int64_t explicit_steps, double beta1, double beta2, double eps,
                        const OptionalTensor& ids, const OptionalTensor& count) {
  AdamTensors state(state_in, tables, {step, explicit_steps, beta1, beta2, eps});
  const OptionalTensor list = state.checked_rows(ids);
  if (count) check_device("count", *count, state.like(), state.name(0));
  const int64_t n = max_listed(count, list ? list->numel() : state.rows());
  DeviceScope scope(state.like());
  dispatch_floating(state.like(), [&]<class T>() {
    auto args = state.arguments<T>(list);
    args.n = n;
    args.count = data_or_null<int32_t>(count);
    if (n > 0) backend::lazy_adam(args, scope.workspace, scope.stream);
  });
}

Tensor lazy_adam_final_rules(const Tensor& table, const Tensor& like, int64_t explicit_steps, double eps) {
  const auto values = checked<double>("table", table, {-1, kAdamTable});
  check_floating("like", like);
  BLITZGS_CHECK(explicit_steps >= 1, "explicit_steps must be 1 or more, got ", explicit_steps);
  const int64_t n = final_rules_of(table.size(0), explicit_steps);
  return dispatch_floating(like, [&]<class T>() -> Tensor {
    AdamArgs<T> args{};
    args.table = values;
    args.explicit_steps = int32_t(explicit_steps);
    args.eps = eps;
    const auto rules = make<uint8_t>(values, {n, sizeof(PendingSteps<T>)});
    run_rows(values, FinalRules<T>{args, reinterpret_cast<PendingSteps<T>*>(rules.data()), n});
    return rules;
  });
}

void position_noise_(const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
                     const Tensor& ids_in, const Tensor& visible_ids_in, int64_t seed, int64_t step,
                     double threshold, double strength) {
  check_floating("means", means);
  const int64_t n = means.size(0);
  const auto ids = checked<int64_t>("ids", ids_in, {n});
  const auto visible_ids = checked<int32_t>("visible_ids", visible_ids_in, {-1});
  dispatch_floating(means, [&]<class T>() {
    const auto moved = checked_in_place<T>("means", means, {n, 3});
    const auto q = checked<T>("quats", quats, {n, 4}), s = checked<T>("scales", scales, {n, 3}),
               o = checked<T>("opacities", opacities, {n});
    if (strength == 0) return;
    run_rows(means, PositionNoise<T>{moved, q, s, o, ids, visible_ids, visible_ids.size(0), seed, step,
                                     threshold, strength});
  });
}

void limit_scales_(const Tensor& scales, const Tensor& means, const Tensor& visible_ids_in, double share,
                   double extent) {
  check_floating("scales", scales);
  const int64_t n = scales.size(0);
  const auto visible_ids = checked<int32_t>("visible_ids", visible_ids_in, {-1});
  BLITZGS_CHECK(share > 0 && extent > 0, "share and extent must be positive, got ", share, " and ", extent);
  dispatch_floating(scales, [&]<class T>() {
    const auto limited = checked_in_place<T>("scales", scales, {n, 3});
    const auto at = checked<T>("means", means, {n, 3});
    run_rows(scales, ScaleLimit<T>{limited, at, visible_ids, visible_ids.size(0), T(share), T(extent)});
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "lazy_adam_step_", lazy_adam_step);
  BLITZGS_OP(m, "lazy_adam_final_rules", lazy_adam_final_rules);
  BLITZGS_OP(m, "lazy_adam_catch_up_", lazy_adam_catch_up);
  BLITZGS_OP(m, "position_noise_", position_noise_);
  BLITZGS_OP(m, "limit_scales_", limit_scales_);
}
