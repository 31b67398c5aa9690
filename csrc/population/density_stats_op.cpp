// SPDX-License-Identifier: Apache-2.0
#include "population/density_stats.h"

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "density_stats_";

void density_stats_(Tensor grad_sum, Tensor grad_count, Tensor max_radii, const Tensor& visible_ids_in,
                    const Tensor& splat_offsets_in, const Tensor& v_means2d_in, const Tensor& conics_in,
                    const std::optional<Tensor>& phi_in, std::int64_t width, std::int64_t height,
                    double weight) {
  check_floating(kOp, "grad_sum", grad_sum);
  const ScalarType dtype = grad_sum.scalar_type();
  const std::int64_t rows = grad_sum.numel();
  check_in_place(kOp, "grad_sum", grad_sum, dtype, {rows});
  check_in_place(kOp, "grad_count", grad_count, ScalarType::Int, {rows});
  check_in_place(kOp, "max_radii", max_radii, dtype, {rows});
  const Tensor visible_ids = checked(kOp, "visible_ids", visible_ids_in, ScalarType::Int, {-1});
  const std::int64_t visible = visible_ids.size(0);
  const Tensor splat_offsets =
      checked(kOp, "splat_offsets", splat_offsets_in, ScalarType::Int, {visible + 1});
  const Tensor conics = checked(kOp, "conics", conics_in, dtype, {-1, 3});
  const std::optional<Tensor> phi = checked(kOp, "phi", phi_in, dtype, {rows});
  check_dtype(kOp, "v_means2d", v_means2d_in, dtype);
  check_shape(kOp, "v_means2d", v_means2d_in, {conics.size(0), 2});
  if (visible == 0) return;
  // If v_means2d is a part of the rows of a gradient table, the kernel reads it there, without a copy.
  const Tensor v_means2d = v_means2d_in.stride(1) == 1 ? v_means2d_in : as_contiguous(v_means2d_in);

  DeviceScope scope(grad_sum);
  dispatch_floating(grad_sum, [&](auto zero) {
    using T = decltype(zero);
    const DensityStatsArgs<T> args{mutable_data<T>(grad_sum),
                                   mutable_data<std::int32_t>(grad_count),
                                   mutable_data<T>(max_radii),
                                   data<std::int32_t>(visible_ids),
                                   data<std::int32_t>(splat_offsets),
                                   data<T>(v_means2d),
                                   v_means2d.stride(0),
                                   data<T>(conics),
                                   data_or_null<T>(phi),
                                   visible,
                                   static_cast<T>(width) / 2,
                                   static_cast<T>(height) / 2,
                                   static_cast<T>(weight)};
    backend::density_stats(args, scope.workspace, scope.stream);
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("density_stats_", TORCH_BOX(&blitzgs::density_stats_)); }
