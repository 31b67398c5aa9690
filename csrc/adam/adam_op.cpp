// SPDX-License-Identifier: Apache-2.0
#include "adam/lazy_adam_op.h"

#include "adam/position_noise.h"
#include "common/op.h"
#include "common/rows.h"

namespace blitzgs {
namespace {

void lazy_adam_step(const std::vector<Tensor>& state, const std::vector<Tensor>& tables, std::int64_t step,
                    std::int64_t explicit_steps, double beta1, double beta2, double eps,
                    const std::vector<Tensor>& grads, const std::optional<Tensor>& ids, bool current,
                    const std::vector<double>& rates, const std::optional<Tensor>& taken) {
  constexpr const char* kOp = "lazy_adam_step_";
  AdamTensors adam(kOp, state, tables, {step, explicit_steps, beta1, beta2, eps});
  float* count = taken ? checked_in_place<float>(kOp, "taken", *taken, {}).data() : nullptr;
  BLITZGS_CHECK(!taken || taken->is_cpu(), kOp, "taken must be on the CPU");
  adam.step_rows(grads, ids, current, rates);
  if (count) ++*count;
}

void lazy_adam_catch_up(const std::vector<Tensor>& state_in, const std::vector<Tensor>& tables,
                        std::int64_t step, std::int64_t explicit_steps, double beta1, double beta2,
                        double eps, const std::optional<Tensor>& ids, const std::optional<Tensor>& count) {
  constexpr const char* kOp = "lazy_adam_catch_up_";
  AdamTensors state(kOp, state_in, tables, {step, explicit_steps, beta1, beta2, eps});
  const std::optional<Tensor> list = state.checked_rows(ids);
  if (count) check_device(kOp, "count", *count, state.like(), state.name(0));
  const std::int64_t n = max_listed(kOp, count, list ? list->numel() : state.rows());
  DeviceScope scope(state.like());
  dispatch_floating(state.like(), [&]<class T>() {
    auto args = state.arguments<T>(list);
    args.n = n;
    args.count = data_or_null<std::int32_t>(count);
    if (n > 0) backend::lazy_adam(args, scope.workspace, scope.stream);
  });
}

Tensor lazy_adam_final_rules(const Tensor& table, const Tensor& like, std::int64_t explicit_steps,
                             double eps) {
  constexpr const char* kOp = "lazy_adam_final_rules";
  const auto values = checked<double>(kOp, "table", table, {-1, kAdamTable});
  check_floating(kOp, "like", like);
  BLITZGS_CHECK(explicit_steps >= 1, kOp, "explicit_steps must be 1 or more, got ", explicit_steps);
  const std::int64_t n = final_rules_of(table.size(0), explicit_steps);
  DeviceScope scope(values);
  return dispatch_floating(like, [&]<class T>() -> Tensor {
    AdamArgs<T> args{};
    args.table = values;
    args.explicit_steps = static_cast<std::int32_t>(explicit_steps);
    args.eps = eps;
    const auto rules = make<std::uint8_t>(values, {n, sizeof(PendingSteps<T>)});
    backend::for_each_row(FinalRules<T>{args, reinterpret_cast<PendingSteps<T>*>(rules.data()), n},
                          scope.stream);
    return rules;
  });
}

void position_noise_(const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
                     const Tensor& ids_in, const Tensor& visible_ids_in, std::int64_t seed, std::int64_t step,
                     double threshold, double strength) {
  constexpr const char* kOp = "position_noise_";
  check_floating(kOp, "means", means);
  const std::int64_t n = means.size(0);
  const auto ids = checked<std::int64_t>(kOp, "ids", ids_in, {n});
  const auto visible_ids = checked<std::int32_t>(kOp, "visible_ids", visible_ids_in, {-1});
  DeviceScope scope(means);
  dispatch_floating(means, [&]<class T>() {
    const auto moved = checked_in_place<T>(kOp, "means", means, {n, 3});
    const auto q = checked<T>(kOp, "quats", quats, {n, 4}), s = checked<T>(kOp, "scales", scales, {n, 3}),
               o = checked<T>(kOp, "opacities", opacities, {n});
    if (strength == 0) return;
    backend::for_each_row(PositionNoise<T>{moved, q, s, o, ids, visible_ids, visible_ids.size(0), seed, step,
                                           threshold, strength},
                          scope.stream);
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("lazy_adam_step_", TORCH_BOX(&blitzgs::lazy_adam_step));
  m.impl("lazy_adam_final_rules", TORCH_BOX(&blitzgs::lazy_adam_final_rules));
  m.impl("lazy_adam_catch_up_", TORCH_BOX(&blitzgs::lazy_adam_catch_up));
  m.impl("position_noise_", TORCH_BOX(&blitzgs::position_noise_));
}
