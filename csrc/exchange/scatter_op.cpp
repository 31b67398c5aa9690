// SPDX-License-Identifier: Apache-2.0
#include "exchange/scatter_op.h"

#include <tuple>

namespace blitzgs {
namespace {

std::tuple<Tensor, Tensor> scatter_splats(const std::vector<Tensor>& columns, const Tensor& masks,
                                          const std::vector<std::int64_t>& group_sizes) {
  constexpr const char* kOp = "scatter_splats";
  HeldSplats held(kOp, columns, masks);
  const SplatGroups groups = checked_groups(kOp, "group_sizes", group_sizes);
  const auto& columns_in = held.splats.columns;
  const std::int64_t words = columns_in.begin[columns_in.count];
  Tensor packed = make_empty(held.masks, {total_splats(groups) * words}, ScalarType::Int);
  Tensor places = make_places(held.masks, held.splats.count, groups.count);
  ScatterTargets targets{};
  for (int m = 0; m < groups.count; ++m) {
    for (int c = 0; c < columns_in.count; ++c) {
      targets.words[m][c] =
          mutable_data<std::int32_t>(packed) + groups.start[m] * words + groups.size[m] * columns_in.begin[c];
    }
  }
  DeviceScope scope(held.masks);
  backend::scatter(held.splats, groups, targets, places_of(places), scope.workspace, scope.stream);
  return {packed, places};
}

std::vector<Tensor> gather_splats(const Tensor& packed, const std::vector<std::int64_t>& widths,
                                  const std::vector<std::int64_t>& group_sizes) {
  constexpr const char* kOp = "gather_splats";
  const SplatGroups groups = checked_groups(kOp, "group_sizes", group_sizes);
  const Tensor words = as_contiguous(packed);
  const std::int64_t n_splats = total_splats(groups);
  std::vector<Tensor> held;
  SplatColumns<std::int32_t> columns{};
  for (const std::int64_t width : widths) {
    STD_TORCH_CHECK(width >= 0, "blitzgs::gather_splats: widths must not be negative, got ", width);
    held.push_back(make_empty(words, {n_splats, width}, ScalarType::Int));
    add_column(kOp, columns, mutable_data<std::int32_t>(held.back()), width);
  }
  check_shape(kOp, "packed", packed, {n_splats * columns.begin[columns.count]});
  check_dtype(kOp, "packed", packed, ScalarType::Int);
  DeviceScope scope(words);
  if (columns.count > 0) {
    backend::gather(data<std::int32_t>(words), groups, columns, scope.workspace, scope.stream);
  }
  return held;
}

std::vector<Tensor> sum_splats(const Tensor& values, const Tensor& places,
                               const std::vector<std::int64_t>& group_sizes, std::int64_t splats,
                               const std::vector<std::int64_t>& widths) {
  constexpr const char* kOp = "sum_splats";
  STD_TORCH_CHECK(splats >= 0, "blitzgs::sum_splats: splats must not be negative, got ", splats);
  check_floating(kOp, "values", values);
  const SplatGroups groups = checked_groups(kOp, "group_sizes", group_sizes);
  const Tensor held = checked_places(kOp, places, splats, groups.count);
  const Tensor values_c = as_contiguous(values);
  std::vector<Tensor> sums;
  for (const std::int64_t width : widths) {
    STD_TORCH_CHECK(width >= 0, "blitzgs::sum_splats: widths must not be negative, got ", width);
    sums.push_back(make_empty(values_c, {splats, width}));
  }
  DeviceScope scope(values_c);
  dispatch_floating(values_c, [&](auto zero) {
    using T = decltype(zero);
    SplatColumns<T> columns{};
    for (Tensor& sum : sums) add_column(kOp, columns, mutable_data<T>(sum), sum.size(1));
    const int width = columns.begin[columns.count];
    check_shape(kOp, "values", values, {total_splats(groups), width});
    const SplatValues<T> returned{data<T>(values_c), width, splats, places_in(held), groups};
    backend::sum(returned, columns, scope.workspace, scope.stream);
  });
  return sums;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("scatter_splats", TORCH_BOX(&blitzgs::scatter_splats));
  m.impl("gather_splats", TORCH_BOX(&blitzgs::gather_splats));
  m.impl("sum_splats", TORCH_BOX(&blitzgs::sum_splats));
}
