// SPDX-License-Identifier: Apache-2.0
#include "pack/pack.h"

#include "common/op.h"

namespace blitzgs {
namespace {

// The contiguous columns and where each lies in a packed row.
struct Columns {
  std::vector<Tensor> held;
  PackColumns layout{};

  void add(const char* op, Tensor column) {
    STD_TORCH_CHECK(layout.count < kMaxPackColumns, "blitzgs::", op, ": at most ", kMaxPackColumns,
                    " columns");
    const std::int64_t end = layout.begin[layout.count] + column.size(1);
    STD_TORCH_CHECK(end <= 4096, "blitzgs::", op, ": a packed row may have 4096 words, got ", end);
    held.push_back(column);
    layout.words[layout.count] = static_cast<std::int32_t*>(held.back().mutable_data_ptr());
    layout.begin[++layout.count] = static_cast<int>(end);
  }
};

Tensor pack_rows(const std::vector<Tensor>& columns, const Tensor& rows) {
  constexpr const char* kOp = "pack_rows";
  STD_TORCH_CHECK(!columns.empty(), "blitzgs::pack_rows: there must be a column");
  check_shape(kOp, "rows", rows, {-1});
  check_dtype(kOp, "rows", rows, ScalarType::Int);
  const Tensor list = as_contiguous(rows);
  Columns all;
  for (const Tensor& column : columns) {
    check_dtype(kOp, "a column", column, ScalarType::Int);
    check_shape(kOp, "a column", column, {columns[0].size(0), -1});
    all.add(kOp, as_contiguous(column));
  }
  Tensor packed = make_empty(list, {list.size(0), all.layout.begin[all.layout.count]}, ScalarType::Int);
  DeviceScope scope(list);
  backend::pack(all.layout, data<std::int32_t>(list), list.size(0), mutable_data<std::int32_t>(packed),
                scope.workspace, scope.stream);
  return packed;
}

std::vector<Tensor> unpack_rows(const Tensor& packed, const std::vector<std::int64_t>& widths) {
  constexpr const char* kOp = "unpack_rows";
  std::int64_t total = 0;
  for (const std::int64_t width : widths) {
    STD_TORCH_CHECK(width >= 0, "blitzgs::unpack_rows: widths must not be negative, got ", width);
    total += width;
  }
  check_shape(kOp, "packed", packed, {-1, total});
  check_dtype(kOp, "packed", packed, ScalarType::Int);
  const Tensor words = as_contiguous(packed);
  Columns all;
  for (const std::int64_t width : widths) all.add(kOp, make_empty(words, {words.size(0), width}));
  DeviceScope scope(words);
  backend::unpack(data<std::int32_t>(words), words.size(0), all.layout, scope.workspace, scope.stream);
  return all.held;
}

Tensor add_rows(const Tensor& values, const Tensor& rows, const std::vector<std::int64_t>& rows_per_rank,
                std::int64_t n_rows) {
  constexpr const char* kOp = "add_rows";
  check_floating(kOp, "values", values);
  check_shape(kOp, "values", values, {-1, -1});
  check_shape(kOp, "rows", rows, {values.size(0)});
  check_dtype(kOp, "rows", rows, ScalarType::Int);
  std::int64_t sum = 0;
  for (const std::int64_t count : rows_per_rank) {
    STD_TORCH_CHECK(count >= 0, "blitzgs::add_rows: rows_per_rank must not be negative, got ", count);
    sum += count;
  }
  STD_TORCH_CHECK(sum == values.size(0), "blitzgs::add_rows: rows_per_rank adds up to ", sum,
                  ", but there are ", values.size(0), " rows");
  const Tensor flat = as_contiguous(values), list = as_contiguous(rows);
  const int width = static_cast<int>(flat.size(1));
  Tensor total = make_zeros(flat, {n_rows, width});
  DeviceScope scope(flat);
  dispatch_floating(flat, [&](auto zero) {
    using T = decltype(zero);
    const T* from = data<T>(flat);
    const std::int32_t* to = data<std::int32_t>(list);
    for (const std::int64_t count : rows_per_rank) {
      backend::add_group(from, to, count, width, mutable_data<T>(total), scope.workspace, scope.stream);
      from += count * width;
      to += count;
    }
  });
  return total;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("pack_rows", TORCH_BOX(&blitzgs::pack_rows));
  m.impl("unpack_rows", TORCH_BOX(&blitzgs::unpack_rows));
  m.impl("add_rows", TORCH_BOX(&blitzgs::add_rows));
}
