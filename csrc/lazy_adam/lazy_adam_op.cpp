// SPDX-License-Identifier: Apache-2.0
#include "lazy_adam/lazy_adam.h"

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kNames[kAdamColumns] = {"means", "quats", "scales", "opacities", "sh"};

struct AdamOptions {
  std::int64_t step, explicit_steps;
  double beta1, beta2, eps;
  bool sparse;
};

void check_state(const char* op, const Tensor& like, const Tensor& tensor, const char* name,
                 std::int64_t rows) {
  check_dtype(op, name, tensor, like.scalar_type());
  STD_TORCH_CHECK(tensor.is_contiguous(), "blitzgs::", op, ": ", name,
                  " is updated in place and must be contiguous");
  STD_TORCH_CHECK(tensor.dim() >= 1 && tensor.size(0) == rows, "blitzgs::", op, ": ", name, " must have ",
                  rows, " rows, got ", shape_of(tensor));
}

void check_lists(const char* op, const std::vector<Tensor>& tensors, const char* name) {
  STD_TORCH_CHECK(tensors.size() == kAdamColumns, "blitzgs::", op, ": ", name,
                  " must hold means, quats, scales, opacities, sh; got ", tensors.size(), " tensors");
}

// grads empty = catch up only.
void run_lazy_adam(const char* op, std::vector<Tensor>& params, std::vector<Tensor>& exp_avgs,
                   std::vector<Tensor>& exp_avg_sqs, const std::vector<Tensor>& grads,
                   const std::optional<Tensor>& ids, Tensor& last_step, Tensor& moment_step,
                   const Tensor& table, const Tensor& lr_table, const AdamOptions& options) {
  check_lists(op, params, "params");
  check_lists(op, exp_avgs, "exp_avgs");
  check_lists(op, exp_avg_sqs, "exp_avg_sqs");
  const Tensor& like = params[0];
  const std::int64_t rows = like.size(0);
  check_floating(op, "means", like);
  check_dtype(op, "last_step", last_step, ScalarType::Int);
  check_shape(op, "last_step", last_step, {rows});
  check_dtype(op, "moment_step", moment_step, ScalarType::Int);
  check_shape(op, "moment_step", moment_step, {rows});
  check_dtype(op, "table", table, ScalarType::Double);
  check_shape(op, "table", table, {-1, kAdamTable});
  check_dtype(op, "lr_table", lr_table, ScalarType::Float);
  check_shape(op, "lr_table", lr_table, {table.size(0), kAdamGroups});
  STD_TORCH_CHECK(table.is_contiguous() && lr_table.is_contiguous() && last_step.is_contiguous() &&
                      moment_step.is_contiguous(),
                  "blitzgs::", op, ": table, lr_table, last_step and moment_step must be contiguous");
  STD_TORCH_CHECK(options.step >= 0 && options.step < table.size(0), "blitzgs::", op, ": step ", options.step,
                  " is outside the learning-rate table, which ends at step ", table.size(0) - 1);
  std::optional<Tensor> list;
  if (ids) {
    check_dtype(op, "ids", *ids, ScalarType::Int);
    check_shape(op, "ids", *ids, {-1});
    list = as_contiguous(*ids);
  }
  const std::int64_t n = list ? list->size(0) : rows;
  std::vector<Tensor> held;
  for (const Tensor& grad : grads) held.push_back(as_contiguous(grad));

  DeviceScope scope(like);
  dispatch_floating(like, [&](auto zero) {
    using T = decltype(zero);
    AdamArgs<T> args{};
    for (int c = 0; c < kAdamColumns; ++c) {
      check_state(op, like, params[c], kNames[c], rows);
      check_state(op, like, exp_avgs[c], kNames[c], rows);
      check_state(op, like, exp_avg_sqs[c], kNames[c], rows);
      const std::int64_t width = rows ? params[c].numel() / rows : 0;
      STD_TORCH_CHECK(exp_avgs[c].numel() == rows * width && exp_avg_sqs[c].numel() == rows * width,
                      "blitzgs::", op, ": the moments of ", kNames[c], " must have its shape ",
                      shape_of(params[c]));
      STD_TORCH_CHECK(c != 1 || width == 4 || rows == 0, "blitzgs::", op,
                      ": quats must have shape [*, 4], got ", shape_of(params[c]));
      args.columns[c] = {mutable_data<T>(params[c]), mutable_data<T>(exp_avgs[c]),
                         mutable_data<T>(exp_avg_sqs[c]), nullptr, width};
      if (held.empty()) continue;
      check_dtype(op, "grads", held[c], like.scalar_type());
      STD_TORCH_CHECK(held[c].dim() >= 1 && held[c].size(0) == n && held[c].numel() == n * width,
                      "blitzgs::", op, ": the gradient of ", kNames[c], " must have ", n, " rows of ", width,
                      " values, got ", shape_of(held[c]));
      args.columns[c].grad = data<T>(held[c]);
    }
    args.ids = data_or_null<std::int32_t>(list);
    args.n = n;
    args.last_step = mutable_data<std::int32_t>(last_step);
    args.moment_step = mutable_data<std::int32_t>(moment_step);
    args.table = data<double>(table);
    args.lr_table = data<float>(lr_table);
    args.step = static_cast<std::int32_t>(options.step);
    args.explicit_steps = static_cast<std::int32_t>(options.explicit_steps);
    args.beta1 = options.beta1;
    args.beta2 = options.beta2;
    args.eps = options.eps;
    args.sparse = options.sparse;
    if (n > 0) backend::lazy_adam(args, scope.workspace, scope.stream);
  });
}

void lazy_adam_step_(std::vector<Tensor> params, std::vector<Tensor> exp_avgs,
                     std::vector<Tensor> exp_avg_sqs, std::vector<Tensor> grads, const Tensor& ids,
                     Tensor last_step, Tensor moment_step, const Tensor& table, const Tensor& lr_table,
                     std::int64_t step, std::int64_t explicit_steps, double beta1, double beta2, double eps,
                     bool sparse) {
  check_lists("lazy_adam_step_", grads, "grads");
  STD_TORCH_CHECK(step >= 1, "blitzgs::lazy_adam_step_: steps count from 1, got ", step);
  run_lazy_adam("lazy_adam_step_", params, exp_avgs, exp_avg_sqs, grads, ids, last_step, moment_step, table,
                lr_table, {step, explicit_steps, beta1, beta2, eps, sparse});
}

void lazy_adam_catch_up_(std::vector<Tensor> params, std::vector<Tensor> exp_avgs,
                         std::vector<Tensor> exp_avg_sqs, const std::optional<Tensor>& ids, Tensor last_step,
                         Tensor moment_step, const Tensor& table, const Tensor& lr_table, std::int64_t step,
                         std::int64_t explicit_steps, double beta1, double beta2, double eps) {
  run_lazy_adam("lazy_adam_catch_up_", params, exp_avgs, exp_avg_sqs, {}, ids, last_step, moment_step, table,
                lr_table, {step, explicit_steps, beta1, beta2, eps, false});
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("lazy_adam_step_", TORCH_BOX(&blitzgs::lazy_adam_step_));
  m.impl("lazy_adam_catch_up_", TORCH_BOX(&blitzgs::lazy_adam_catch_up_));
}
