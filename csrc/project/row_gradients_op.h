// SPDX-License-Identifier: Apache-2.0
// Gradients of rows as the ops of the projection's backward pass are given them: four or five columns of the
// rows or, with places, of what came back from the ranks (scatter/scatter.h). Columns may be views of one
// table, which CUDA then reads where it lies.
#pragma once
#include <optional>
#include <vector>

#include "common/op.h"
#include "project/row_gradients.h"
#include "scatter/scatter_op.h"

namespace blitzgs {

class HeldRowGradients {
 public:
#ifdef BLITZGS_BACKEND_CUDA
  template <class T>
  using Source = RowGradientSource;
#else
  template <class T>
  using Source = ProjectRowGradients<T>;
#endif

  // rows: P.
  HeldRowGradients(const char* op, ScalarType dtype, std::int64_t rows, const Tensor& means2d,
                   const Tensor& conics, const std::optional<Tensor>& depths, const Tensor& opacities,
                   const std::optional<Tensor>& colors, const std::optional<Tensor>& places,
                   const std::vector<std::int64_t>& group_sizes, std::int64_t own_rank,
                   const std::optional<Tensor>& own)
      : op_(op), means2d_(means2d), conics_(conics), opacities_(opacities), depths_(depths), colors_(colors) {
    std::int64_t n = rows;
    if (places) {
      n = total_rows(returns_.emplace(op, rows, *places, group_sizes, own_rank, own, dtype).groups);
    }
    STD_TORCH_CHECK(!own || !depths, "blitzgs::", op, ": own has no gradients of depths");
    check_shape(op, "v_means2d", means2d, {n, 2});
    check_shape(op, "v_conics", conics, {n, 3});
    check_shape(op, "v_row_opacities", opacities, {n});
    if (depths) check_shape(op, "v_depths", *depths, {n});
    if (colors) check_shape(op, "v_colors", *colors, {n, 3});
    each_column([&](const Tensor& column) { check_dtype(op, "row gradients", column, dtype); });
  }

  // What the kernels read; this and what `scope` allocates have to outlive them.
  template <class T>
  Source<T> source(DeviceScope& scope) {
#ifdef BLITZGS_BACKEND_CUDA
    const std::int64_t width = table_width();
    const auto* table = data<float>(means2d_);
    if (width > 0 && returns_) {
      return ReturnedRowGradients{returns_->values(op_, table, width, 0, kRowGradient)};
    }
    if (width * sizeof(float) == sizeof(PackedRowGradients::Row) && lies_at(table, 16)) {
      return PackedRowGradients{reinterpret_cast<const PackedRowGradients::Row*>(table)};
    }
#endif
    std::int64_t before = 0;  // columns of a table in the order of kRowGradient
    each_column([&](Tensor& column) {
      const std::int64_t width = column.dim() == 1 ? 1 : column.size(1);
      column = returns_ ? add_up<T>(column, before, width, scope) : as_contiguous(column);
      before += width;
    });
    return ProjectRowGradients<T>{data<T>(means2d_), data<T>(conics_), data_or_null<T>(depths_),
                                  data<T>(opacities_), data_or_null<T>(colors_)};
  }

 private:
  template <class F>
  void each_column(const F& f) {
    for (Tensor* column : {&means2d_, &conics_, &opacities_}) f(*column);
    for (std::optional<Tensor>* column : {&depths_, &colors_}) {
      if (*column) f(**column);
    }
  }

#ifdef BLITZGS_BACKEND_CUDA
  static bool lies_at(const void* address, std::uintptr_t multiple) {
    return reinterpret_cast<std::uintptr_t>(address) % multiple == 0;
  }

  // Floats in a row of the table that the columns are views of, in the order of kRowGradient; 0: there is
  // none.
  std::int64_t table_width() const {
    if (depths_ || !colors_) return 0;
    const std::int64_t width = means2d_.stride(0);
    const auto* table = data<float>(means2d_);
    const auto follows = [&](const Tensor& column, int offset) {
      return data<float>(column) == table + offset && column.stride(0) == width &&
             (column.dim() == 1 || column.stride(1) == 1);
    };
    const bool found = width >= kRowGradient && follows(means2d_, 0) && follows(conics_, 2) &&
                       follows(opacities_, 5) && follows(*colors_, 6);
    return found ? width : 0;
  }
#endif

  // Sums over the ranks, in a column of its own.
  template <class T>
  Tensor add_up(const Tensor& column, std::int64_t before, std::int64_t width, DeviceScope& scope) const {
    const Tensor returned = as_contiguous(column);
    const std::int64_t rows = returns_->rows;
    Tensor sums = column.dim() == 1 ? make_empty(column, {rows}) : make_empty(column, {rows, width});
    RowColumns<T> columns{};
    add_column(op_, columns, mutable_data<T>(sums), width);
    backend::sum(returns_->values(op_, data<T>(returned), width, before, width), columns, scope.workspace,
                 scope.stream);
    return sums;
  }

  const char* op_;
  Tensor means2d_, conics_, opacities_;
  std::optional<Tensor> depths_, colors_;
  std::optional<HeldReturns> returns_;
};

}  // namespace blitzgs
