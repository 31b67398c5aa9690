// SPDX-License-Identifier: Apache-2.0
#include "population/take_rows.h"

#include "common/op.h"

namespace blitzgs {
namespace {

std::int64_t row_elements(const Tensor& column) {
  std::int64_t elements = 1;
  for (std::int64_t axis = 1; axis < column.dim(); ++axis) elements *= column.size(axis);
  return elements;
}

Tensor take_rows(const Tensor& column, const Tensor& rows, const std::optional<Tensor>& fresh) {
  constexpr const char* kOp = "take_rows";
  STD_TORCH_CHECK(column.dim() >= 1, "blitzgs::take_rows: column must have rows, got ", shape_of(column));
  check_shape(kOp, "rows", rows, {-1});
  check_dtype(kOp, "rows", rows, ScalarType::Long);
  const Tensor old = as_contiguous(column), places = as_contiguous(rows);
  std::optional<Tensor> added;
  if (fresh) {
    check_dtype(kOp, "fresh", *fresh, column.scalar_type());
    STD_TORCH_CHECK(fresh->dim() == column.dim() && row_elements(*fresh) == row_elements(column),
                    "blitzgs::take_rows: rows of fresh must be like those of column, got ", shape_of(*fresh),
                    " for ", shape_of(column));
    added = as_contiguous(*fresh);
  }
  std::vector<std::int64_t> shape{places.size(0)};
  for (std::int64_t axis = 1; axis < column.dim(); ++axis) shape.push_back(column.size(axis));
  Tensor out = make_empty(old, shape);
  const auto row_bytes = row_elements(old) * static_cast<std::int64_t>(old.element_size());
  STD_TORCH_CHECK(row_bytes < (1 << 16), "blitzgs::take_rows: rows must be shorter than 64 KiB, got ",
                  row_bytes, " bytes");
  DeviceScope scope(old);
  backend::take_rows({static_cast<const std::byte*>(old.const_data_ptr()), data_or_null<std::byte>(added),
                      static_cast<std::byte*>(out.mutable_data_ptr()), data<std::int64_t>(places),
                      places.size(0), old.size(0), row_bytes},
                     scope.workspace, scope.stream);
  return out;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("take_rows", TORCH_BOX(&blitzgs::take_rows)); }
