// SPDX-License-Identifier: Apache-2.0
#include "render/gather_rows_op.h"

namespace blitzgs {
namespace {

// The first `length` rows of a tensor, or all if it has no more.
Tensor rows_of(const Tensor& tensor, std::int64_t length) {
  std::vector<std::int64_t> shape, strides;
  for (std::int64_t axis = 0; axis < tensor.dim(); ++axis) {
    shape.push_back(tensor.size(axis));
    strides.push_back(tensor.stride(axis));
  }
  shape[0] = std::min(shape[0], length);
  return view_of(tensor, shape, strides, 0);
}

// Words of 4 bytes in the elements of a row behind its first `axis` dimensions.
std::int64_t words_behind(const Tensor& column, std::int64_t axis) {
  std::int64_t words = static_cast<std::int64_t>(column.element_size()) / 4;
  for (; axis < column.dim(); ++axis) words *= column.size(axis);
  return words;
}

void check_column(const char* op, const Tensor& column) {
  STD_TORCH_CHECK(column.dim() >= 1 && column.element_size() % 4 == 0, "blitzgs::", op,
                  ": columns must have rows and elements of 4 or 8 bytes, got ", shape_of(column), " of ",
                  column.element_size(), " bytes");
  STD_TORCH_CHECK(words_behind(column, 1) < (1 << 16), "blitzgs::", op,
                  ": rows must be shorter than 256 KiB, got ", shape_of(column));
}

std::vector<std::int64_t> shape_with(const Tensor& column, std::int64_t rows) {
  std::vector<std::int64_t> shape{rows};
  for (std::int64_t axis = 1; axis < column.dim(); ++axis) shape.push_back(column.size(axis));
  return shape;
}

}  // namespace

std::vector<Tensor> gathered_rows(const char* op, const std::vector<Tensor>& columns,
                                  const std::vector<Tensor>& joined, const Tensor& ids,
                                  const std::int64_t* known) {
  STD_TORCH_CHECK(columns.size() + joined.size() <= kMaxGatheredColumns, "blitzgs::", op, ": at most ",
                  kMaxGatheredColumns, " columns, got ", columns.size() + joined.size());
  const std::int64_t n = ids.size(0);
  GatherRows gather{data<std::int32_t>(ids), n, known, 0, {}};
  std::vector<Tensor> held, found;
  const auto add = [&](const Tensor& column, std::uint32_t* to, std::int64_t stride) {
    const Tensor& from = held.emplace_back(as_contiguous(column));
    const auto width = static_cast<std::uint32_t>(words_behind(from, 1));
    gather.columns[gather.n_columns++] = {static_cast<const std::uint32_t*>(from.const_data_ptr()), to, width,
                                          stride, width};
    return width;
  };
  for (const Tensor& column : columns) {
    check_column(op, column);
    Tensor& rows = found.emplace_back(make_empty(column, shape_with(column, n)));
    add(column, static_cast<std::uint32_t*>(rows.mutable_data_ptr()), words_behind(column, 1));
  }
  if (!joined.empty()) {
    std::int64_t length = 0, stride = 0;
    for (const Tensor& part : joined) {
      check_column(op, part);
      check_dtype(op, "joined columns", part, joined[0].scalar_type());
      STD_TORCH_CHECK(part.dim() >= 2 && part.dim() == joined[0].dim() &&
                          words_behind(part, 2) == words_behind(joined[0], 2),
                      "blitzgs::", op, ": joined columns must be alike behind their second dimension, got ",
                      shape_of(part), " beside ", shape_of(joined[0]));
      length += part.size(1);
      stride += words_behind(part, 1);
    }
    std::vector<std::int64_t> shape = shape_with(joined[0], n);
    shape[1] = length;
    Tensor& rows = found.emplace_back(make_empty(joined[0], shape));
    auto* to = static_cast<std::uint32_t*>(rows.mutable_data_ptr());
    for (const Tensor& part : joined) to += add(part, to, stride);
  }
  DeviceScope scope(ids);
  backend::gather_rows(gather, scope.workspace, scope.stream);
  return found;
}

namespace {

std::vector<Tensor> first_rows(const std::vector<Tensor>& columns, const std::vector<std::int64_t>& lengths) {
  constexpr const char* kOp = "first_rows";
  STD_TORCH_CHECK(columns.size() == lengths.size(), "blitzgs::", kOp, ": ", columns.size(),
                  " columns need a length each, got ", lengths.size());
  std::vector<Tensor> found;
  for (std::size_t c = 0; c < columns.size(); ++c) {
    STD_TORCH_CHECK(columns[c].dim() >= 1 && lengths[c] >= 0, "blitzgs::", kOp,
                    ": columns must have rows, and lengths be at least 0, got ", shape_of(columns[c]),
                    " and ", lengths[c]);
    found.push_back(rows_of(columns[c], lengths[c]));
  }
  return found;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("first_rows", TORCH_BOX(&blitzgs::first_rows)); }
