// SPDX-License-Identifier: Apache-2.0
#include "active/cull_mask.h"

#include "common/op.h"

namespace blitzgs {
namespace {

Tensor sectors_of_rows(const Tensor& rows_in) {
  check_dtype("sectors_of_rows", "rows", rows_in, ScalarType::Int);
  check_shape("sectors_of_rows", "rows", rows_in, {-1, -1});
  Tensor rows = as_contiguous(rows_in);
  const std::int64_t n = rows.size(0), words = rows.size(1);
  Tensor sectors = make_empty(rows, {blocks_of(n), 32 * words, kSectorWords});
  DeviceScope scope(rows);
  backend::sectors_of_rows({mutable_data<std::int32_t>(rows), mutable_data<std::int32_t>(sectors), n, words},
                           scope.stream);
  return sectors;
}

Tensor rows_of_sectors(const Tensor& sectors_in, std::int64_t n) {
  constexpr const char* kOp = "rows_of_sectors";
  check_dtype(kOp, "sectors", sectors_in, ScalarType::Int);
  check_shape(kOp, "sectors", sectors_in, {blocks_of(n), -1, kSectorWords});
  STD_TORCH_CHECK(sectors_in.size(1) % 32 == 0, "blitzgs::", kOp,
                  ": sectors must be of a multiple of 32 columns, got ", sectors_in.size(1));
  Tensor sectors = as_contiguous(sectors_in);
  const std::int64_t words = sectors.size(1) / 32;
  Tensor rows = make_empty(sectors, {n, words});
  DeviceScope scope(sectors);
  backend::rows_of_sectors({mutable_data<std::int32_t>(rows), mutable_data<std::int32_t>(sectors), n, words},
                           scope.stream);
  return rows;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("sectors_of_rows", TORCH_BOX(&blitzgs::sectors_of_rows));
  m.impl("rows_of_sectors", TORCH_BOX(&blitzgs::rows_of_sectors));
}
