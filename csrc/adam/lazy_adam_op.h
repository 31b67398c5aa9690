// SPDX-License-Identifier: Apache-2.0
// The checked tensors of the optimiser's state and schedule, for all ops that move parameters.
#pragma once
#include <utility>

#include "adam/lazy_adam.h"
#include "common/op.h"

namespace blitzgs {

inline constexpr const char* kAdamNames[kAdamColumns] = {"means", "quats", "scales", "opacities", "sh"};

// The tensors of a state: each column's parameter, first and second moment; last_step, moment_step.
inline constexpr size_t kAdamState = 3 * kAdamColumns + 2, kAloneState = 3 + 2;

struct AdamConstants {
  int64_t step, explicit_steps;
  double beta1, beta2, eps;
};

// The optimiser's state of a table of Gaussians and its schedule. state: (params, exp_avgs, exp_avg_sqs,
// last_step, moment_step), of which each of the first three is (means, quats, scales, opacities, sh), or a
// single parameter of any width, which takes the place of sh; tables: (table of lazy_adam.h, lr_table[,
// final_rules]). blitzgs/ops/lazy_adam.py builds these groups.
struct AdamTensors {
  bool alone;  // a single parameter
  TensorList params, exp_avgs, exp_avg_sqs;
  Tensor last_step, moment_step, table, lr_table;
  OptionalTensor final_rules;
  AdamConstants constants;

  AdamTensors(const TensorList& state, const TensorList& tables, const AdamConstants& constants_in)
      : alone(state.size() == kAloneState), constants(constants_in) {
    BLITZGS_CHECK((alone || state.size() == kAdamState) && (tables.size() == 2 || tables.size() == 3),
                  "expected state (params, exp_avgs and exp_avg_sqs of means, quats, scales, opacities ",
                  "and sh, or of one parameter, last_step, moment_step) and tables (table, lr_table[, ",
                  "final_rules]); got ", state.size(), " and ", tables.size(), " entries");
    auto next = state.begin();
    for (TensorList* columns : {&params, &exp_avgs, &exp_avg_sqs}) {
      columns->assign(next, next + count());
      next += count();
    }
    last_step = *next++;
    moment_step = *next;
    table = tables[0];
    lr_table = tables[1];
    if (tables.size() == 3) final_rules = tables[2];
    check();
  }

  // The number of columns that the state has, and the kernel's column of the first of them.
  int count() const { return alone ? 1 : kAdamColumns; }
  int first() const { return kAdamColumns - count(); }

  const Tensor& like() const { return params[0]; }
  const char* name(int column) const { return alone ? "the parameter" : kAdamNames[column]; }
  int64_t rows() const { return like().size(0); }

  // Checks a list of rows, int32 [n] or int64 [n] or [1, n] (as sparse tensors have them); none: all rows.
  OptionalTensor checked_rows(const OptionalTensor& ids) const {
    if (!ids) return std::nullopt;
    check_device("ids", *ids, like(), name(0));
    const bool is_long = ids->scalar_type() == ScalarType::Long;
    if (is_long && ids->dim() == 2) return checked("ids", *ids, ScalarType::Long, {1, -1});
    return checked("ids", *ids, is_long ? ScalarType::Long : ScalarType::Int, {-1});
  }

  // The kernel's arguments for the rows of a list (`checked_rows`). The caller sets gradients.
  template <class T> AdamArgs<T> arguments(const OptionalTensor& ids) {
    AdamArgs<T> args{};
    for (int c = 0; c < count(); ++c) {
      args.columns[first() + c] = {mutable_data<T>(params[c]), mutable_data<T>(exp_avgs[c]),
                                   mutable_data<T>(exp_avg_sqs[c]), nullptr, width(c)};
    }
    if (ids && ids->scalar_type() == ScalarType::Long) {
      args.long_ids = data<int64_t>(*ids);
    } else {
      args.ids = data_or_null<int32_t>(ids);
    }
    args.n = ids ? ids->numel() : rows();
    args.last_step = mutable_data<int32_t>(last_step);
    args.moment_step = mutable_data<int32_t>(moment_step);
    args.table = data<double>(table);
    args.lr_table = data<float>(lr_table);
    if (final_rules) {
      const auto bytes = checked_in_place<uint8_t>(
          "final_rules", *final_rules,
          {final_rules_of(table.size(0), constants.explicit_steps), sizeof(PendingSteps<T>)});
      args.final_rules = reinterpret_cast<const PendingSteps<T>*>(bytes.data());
    }
    args.step = int32_t(constants.step);
    args.explicit_steps = int32_t(constants.explicit_steps);
    args.beta1 = constants.beta1;
    args.beta2 = constants.beta2;
    args.eps = constants.eps;
    return args;
  }

  void check_takes_step() const {
    BLITZGS_CHECK(constants.step >= 1, "steps count from 1, got ", constants.step);
  }

  int64_t width(int column) const { return rows() ? params[column].numel() / rows() : 0; }

 private:
  void check() const {
    check_floating("means", like());
    for (int c = 0; c < count(); ++c) {
      for (const Tensor* tensor : {&params[c], &exp_avgs[c], &exp_avg_sqs[c]}) check_column(*tensor, c);
    }
    for (const auto& [c, values] : {std::pair{0, 3}, std::pair{1, 4}, std::pair{2, 3}, std::pair{3, 1}}) {
      BLITZGS_CHECK(alone || params[c].numel() == values * rows(), kAdamNames[c], " must have ", values,
                    " values in each of ", rows(), " rows, got ", shape_of(params[c]));
    }
    for (const auto& [what, tensor] :
         {std::pair{"last_step", &last_step}, std::pair{"moment_step", &moment_step},
          std::pair{"table", &table}, std::pair{"lr_table", &lr_table}}) {
      check_device(what, *tensor, like(), name(0));
    }
    check_in_place("last_step", last_step, ScalarType::Int, {rows()});
    check_in_place("moment_step", moment_step, ScalarType::Int, {rows()});
    check_in_place("table", table, ScalarType::Double, {-1, kAdamTable});
    check_in_place("lr_table", lr_table, ScalarType::Float, {table.size(0), kAdamGroups});
    const int64_t step = constants.step;
    BLITZGS_CHECK(step >= 0 && step < table.size(0), "step ", step,
                  " is outside the learning-rate table, which ends at step ", table.size(0) - 1);
  }

  void check_column(const Tensor& tensor, int column) const {
    check_device("a parameter or moment", tensor, like(), name(0));
    check_dtype(name(column), tensor, like().scalar_type());
    check_contiguous(name(column), tensor);
    BLITZGS_CHECK(tensor.dim() >= 1 && tensor.size(0) == rows(), name(column), " must have ", rows(),
                  " rows, got ", shape_of(tensor));
    BLITZGS_CHECK(tensor.numel() == params[column].numel(), "the moments of ", name(column),
                  " must have its shape ", shape_of(params[column]));
  }
};

}  // namespace blitzgs
