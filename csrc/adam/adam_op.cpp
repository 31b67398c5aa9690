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
                    const std::vector<double>& rates, std::optional<Tensor> taken) {
  constexpr const char* kOp = "lazy_adam_step_";
  AdamTensors adam(kOp, state, tables, {step, explicit_steps, beta1, beta2, eps});
  if (taken) {
    check_in_place(kOp, "taken", *taken, ScalarType::Float, {});
    BLITZGS_CHECK(taken->is_cpu(), kOp, "taken must be on the CPU");
  }
  adam.step_rows(grads, ids, current, rates);
  if (taken) ++*mutable_data<float>(*taken);
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
  const Tensor contiguous = checked(kOp, "table", table, ScalarType::Double, {-1, kAdamTable});
  check_floating(kOp, "like", like);
  BLITZGS_CHECK(explicit_steps >= 1, kOp, "explicit_steps must be 1 or more, got ", explicit_steps);
  const std::int64_t n = final_rules_of(table.size(0), explicit_steps);
  std::optional<Tensor> rules;
  DeviceScope scope(contiguous);
  dispatch_floating(like, [&]<class T>() {
    AdamArgs<T> args{};
    args.table = data<double>(contiguous);
    args.explicit_steps = static_cast<std::int32_t>(explicit_steps);
    args.eps = eps;
    rules = make_empty(contiguous, {n, static_cast<std::int64_t>(sizeof(PendingSteps<T>))}, ScalarType::Byte);
    backend::final_rules(args, n, static_cast<PendingSteps<T>*>(rules->mutable_data_ptr()), scope.stream);
  });
  return *rules;
}

constexpr const char* kPositionNoise = "position_noise_";

void position_noise_(Tensor means, const Tensor& quats_in, const Tensor& scales_in,
                     const Tensor& opacities_in, const Tensor& ids_in, const Tensor& visible_ids_in,
                     std::int64_t seed, std::int64_t step, double threshold, double strength) {
  check_floating(kPositionNoise, "means", means);
  const ScalarType dtype = means.scalar_type();
  check_in_place(kPositionNoise, "means", means, dtype, {-1, 3});
  const std::int64_t rows = means.size(0);
  const Tensor quats = checked(kPositionNoise, "quats", quats_in, dtype, {rows, 4}),
               scales = checked(kPositionNoise, "scales", scales_in, dtype, {rows, 3}),
               opacities = checked(kPositionNoise, "opacities", opacities_in, dtype, {rows}),
               ids = checked(kPositionNoise, "ids", ids_in, ScalarType::Long, {rows}),
               visible_ids = checked(kPositionNoise, "visible_ids", visible_ids_in, ScalarType::Int, {-1});
  const std::int64_t visible = visible_ids.size(0);
  if (visible == 0 || strength == 0) return;

  DeviceScope scope(means);
  dispatch_floating(means, [&]<class T>() {
    const PositionNoise<T> args{mutable_data<T>(means),
                                data<T>(quats),
                                data<T>(scales),
                                data<T>(opacities),
                                data<std::int64_t>(ids),
                                data<std::int32_t>(visible_ids),
                                visible,
                                seed,
                                step,
                                threshold,
                                strength};
    backend::for_each_row(args, scope.stream);
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
