// SPDX-License-Identifier: Apache-2.0
// The optional argument n_rows of an op, int64 [1]: how many rows of its columns are valid (row_count.h).
#pragma once
#include <optional>

#include "common/op.h"
#include "common/row_count.h"

namespace blitzgs {

struct RowCount {
  std::int64_t n_rows;  // at most
  const std::int64_t*
      known_rows;  // null: all n_rows; otherwise the kernels read it, and the host does not wait
};

inline RowCount checked_row_count(const char* op, const std::optional<Tensor>& n_rows, const Tensor& rows) {
  const std::int64_t room = rows.size(0);
  if (!n_rows) return {room, nullptr};
  check_dtype(op, "n_rows", *n_rows, ScalarType::Long);
  check_shape(op, "n_rows", *n_rows, {1});
  STD_TORCH_CHECK(n_rows->is_cpu() == rows.is_cpu() && n_rows->get_device_index() == rows.get_device_index(),
                  "blitzgs::", op, ": n_rows must be on the device of the rows");
#ifdef BLITZGS_BACKEND_CUDA
  return {room, data<std::int64_t>(*n_rows)};
#else
  return {rows_there(room, data<std::int64_t>(*n_rows)), nullptr};
#endif
}

}  // namespace blitzgs
