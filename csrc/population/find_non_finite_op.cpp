// SPDX-License-Identifier: Apache-2.0
#include "population/find_non_finite.h"

#include "common/op.h"

namespace blitzgs {
namespace {

Tensor find_non_finite(const std::vector<Tensor>& columns_in, const std::vector<Tensor>& nonzero_in) {
  constexpr const char* kOp = "find_non_finite";
  STD_TORCH_CHECK(!columns_in.empty(), "blitzgs::", kOp, ": there must be columns");
  std::vector<Tensor> columns;
  for (const std::vector<Tensor>* list : {&columns_in, &nonzero_in}) {
    for (const Tensor& column : *list) {
      check_floating(kOp, "a column", column);
      check_dtype(kOp, "a column", column, columns_in[0].scalar_type());
      columns.push_back(as_contiguous(column));
    }
  }
  Tensor bad = make_empty(columns[0], {}, ScalarType::Int);
  DeviceScope scope(columns[0]);
  backend::clear_flag(mutable_data<std::int32_t>(bad), scope.stream);
  dispatch_floating(columns[0], [&](auto zero) {
    using T = decltype(zero);
    for (std::size_t first = 0; first < columns.size(); first += kMaxCheckedColumns) {
      CheckedColumns<T> checked{{}, 0, mutable_data<std::int32_t>(bad)};
      for (std::size_t c = first; c < columns.size() && checked.n < kMaxCheckedColumns; ++c) {
        checked.columns[checked.n++] = {data<T>(columns[c]), columns[c].numel(), c >= columns_in.size()};
      }
      backend::check_columns(checked, scope.stream);
    }
  });
  return bad;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("find_non_finite", TORCH_BOX(&blitzgs::find_non_finite)); }
