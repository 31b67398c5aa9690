// SPDX-License-Identifier: Apache-2.0
#include "active/pool.h"

#include "common/op.h"

namespace blitzgs {
namespace {

Tensor seen_blocks(const Tensor& bounds, const Tensor& viewmats_in, const Tensor& Ks_in,
                   const Tensor& sizes_in, double near_plane, double far_plane, double eps2d) {
  constexpr const char* kOp = "seen_blocks";
  check_dtype(kOp, "bounds", bounds, ScalarType::Float);
  check_shape(kOp, "bounds", bounds, {-1, kBlockBounds});
  check_dtype(kOp, "viewmats", viewmats_in, ScalarType::Float);
  check_shape(kOp, "viewmats", viewmats_in, {-1, 4, 4});
  const std::int64_t views = viewmats_in.size(0);
  STD_TORCH_CHECK(views <= kMaxViews, "blitzgs::", kOp, ": at most ", kMaxViews, " views at once, got ",
                  views);
  check_dtype(kOp, "Ks", Ks_in, ScalarType::Float);
  check_shape(kOp, "Ks", Ks_in, {views, 3, 3});
  check_dtype(kOp, "sizes", sizes_in, ScalarType::Int);
  check_shape(kOp, "sizes", sizes_in, {views, 2});
  const Tensor boxes = as_contiguous(bounds), viewmats = as_contiguous(viewmats_in);
  const Tensor Ks = as_contiguous(Ks_in), sizes = as_contiguous(sizes_in);
  Tensor seen = make_empty(boxes, {boxes.size(0)}, ScalarType::Int);
  DeviceScope scope(boxes);
  backend::seen_blocks(
      {data<float>(boxes), boxes.size(0), data<float>(viewmats), data<float>(Ks), data<std::int32_t>(sizes),
       static_cast<int>(views), static_cast<float>(near_plane), static_cast<float>(far_plane),
       static_cast<float>(eps2d), mutable_data<std::int32_t>(seen)},
      scope.workspace, scope.stream);
  return seen;
}

// Checks a column of the pool and of the table, and returns the bytes of a block of this column.
std::int64_t check_pair(const char* op, const Tensor& pool, const Tensor& table) {
  STD_TORCH_CHECK(pool.dim() >= 1 && pool.dim() == table.dim(), "blitzgs::", op,
                  ": columns must have rows, and as many axes in pool and table; got ", shape_of(pool),
                  " and ", shape_of(table));
  check_dtype(op, "a column of the pool", pool, table.scalar_type());
  std::int64_t elements = 1;
  for (std::int64_t axis = 1; axis < pool.dim(); ++axis) {
    STD_TORCH_CHECK(pool.size(axis) == table.size(axis), "blitzgs::", op,
                    ": rows of pool and table must be alike, got ", shape_of(pool), " and ", shape_of(table));
    elements *= pool.size(axis);
  }
  for (const Tensor* column : {&pool, &table}) check_contiguous(op, "columns", *column);
  STD_TORCH_CHECK(table.is_cpu(), "blitzgs::", op, ": the table must be in the memory of the host");
  return kBlockRows * elements * static_cast<std::int64_t>(pool.element_size());
}

void swap_blocks_(std::vector<Tensor> pool, std::vector<Tensor> table, std::int64_t n_written,
                  const Tensor& slots, const Tensor& leaving, const Tensor& coming) {
  constexpr const char* kOp = "swap_blocks_";
  const auto n_columns = static_cast<std::int64_t>(pool.size());
  STD_TORCH_CHECK(n_columns <= kMaxSwapColumns && table.size() == pool.size(), "blitzgs::", kOp,
                  ": pool and table must have the same columns, at most ", kMaxSwapColumns, "; got ",
                  n_columns, " and ", table.size());
  SwapBlocks swap{};
  swap.n = slots.size(0);
  for (const auto& [name, list] :
       {std::pair{"slots", &slots}, std::pair{"leaving", &leaving}, std::pair{"coming", &coming}}) {
    check_in_place(kOp, name, *list, ScalarType::Int, {swap.n});
  }
  for (std::int64_t c = 0; c < n_columns; ++c) {
    const std::int64_t bytes = check_pair(kOp, pool[c], table[c]);
    if (bytes == 0) continue;
    swap.columns[swap.n_columns++] = {static_cast<std::byte*>(pool[c].mutable_data_ptr()),
                                      static_cast<std::byte*>(table[c].mutable_data_ptr()), bytes,
                                      c < n_written};
  }
  swap.slots = data<std::int32_t>(slots);
  swap.leaving = data<std::int32_t>(leaving);
  swap.coming = data<std::int32_t>(coming);
  if (swap.n == 0 || n_columns == 0) return;
  DeviceScope scope(slots);
  backend::swap_blocks(swap, scope.workspace, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("seen_blocks", TORCH_BOX(&blitzgs::seen_blocks));
  m.impl("swap_blocks_", TORCH_BOX(&blitzgs::swap_blocks_));
}
