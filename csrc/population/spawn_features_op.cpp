// SPDX-License-Identifier: Apache-2.0
#include "population/spawn_features.h"

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "spawn_features";

Tensor spawn_features(const std::vector<Tensor>& columns, const Tensor& rows_in, const Tensor& is_split_in,
                      std::int64_t time, double extent, std::int64_t level_count) {
  STD_TORCH_CHECK(columns.size() == 7, "blitzgs::", kOp,
                  ": columns must be (grad_sum, grad_count, opacities, scales, birth, level, "
                  "exp_avg_sq.sh), got ",
                  columns.size(), " tensors");
  const std::int64_t n = columns[0].size(0);
  const auto column = [&](int i, const char* name, ScalarType dtype,
                          std::initializer_list<std::int64_t> shape) {
    return checked(kOp, name, columns[i], dtype, shape);
  };
  const Tensor grad_sum = column(0, "grad_sum", ScalarType::Float, {n}),
               grad_count = column(1, "grad_count", ScalarType::Int, {n}),
               opacities = column(2, "opacities", ScalarType::Float, {n}),
               scales = column(3, "scales", ScalarType::Float, {n, 3}),
               birth = column(4, "birth", ScalarType::Int, {n}),
               level = column(5, "level", ScalarType::Byte, {n}),
               moments = column(6, "exp_avg_sq.sh", ScalarType::Float, {n, -1, 3});
  STD_TORCH_CHECK(moments.size(1) > 0, "blitzgs::", kOp, ": exp_avg_sq.sh must have coefficients");
  STD_TORCH_CHECK(extent > 0, "blitzgs::", kOp, ": extent must be positive, got ", extent);
  STD_TORCH_CHECK(level_count > 0, "blitzgs::", kOp, ": level_count must be positive, got ", level_count);
  const Tensor rows = checked(kOp, "rows", rows_in, ScalarType::Long, {-1}),
               is_split = checked(kOp, "is_split", is_split_in, ScalarType::Bool, {rows.size(0)});
  Tensor features = make_empty(grad_sum, {rows.size(0), kSpawnFeatures});
  DeviceScope scope(grad_sum);
  const SpawnFeaturesArgs args{data<float>(grad_sum),
                               data<std::int32_t>(grad_count),
                               data<float>(opacities),
                               data<float>(scales),
                               data<std::int32_t>(birth),
                               data<std::uint8_t>(level),
                               data<float>(moments),
                               3 * moments.size(1),
                               data<std::int64_t>(rows),
                               data<bool>(is_split),
                               rows.size(0),
                               time,
                               extent,
                               static_cast<int>(level_count),
                               mutable_data<float>(features)};
  backend::spawn_features(args, scope.stream);
  return features;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("spawn_features", TORCH_BOX(&blitzgs::spawn_features)); }
