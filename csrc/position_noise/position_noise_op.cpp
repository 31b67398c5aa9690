// SPDX-License-Identifier: Apache-2.0
#include "position_noise/position_noise.h"

#include "common/op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "position_noise_";

void position_noise_(Tensor means, const Tensor& quats_in, const Tensor& scales_in,
                     const Tensor& opacities_in, const Tensor& ids_in, const Tensor& visible_ids_in,
                     std::int64_t seed, std::int64_t step, double threshold, double strength) {
  check_floating(kOp, "means", means);
  const ScalarType dtype = means.scalar_type();
  check_in_place(kOp, "means", means, dtype, {-1, 3});
  const std::int64_t rows = means.size(0);
  check_dtype(kOp, "quats", quats_in, dtype);
  check_shape(kOp, "quats", quats_in, {rows, 4});
  check_dtype(kOp, "scales", scales_in, dtype);
  check_shape(kOp, "scales", scales_in, {rows, 3});
  check_dtype(kOp, "opacities", opacities_in, dtype);
  check_shape(kOp, "opacities", opacities_in, {rows});
  check_dtype(kOp, "ids", ids_in, ScalarType::Long);
  check_shape(kOp, "ids", ids_in, {rows});
  check_dtype(kOp, "visible_ids", visible_ids_in, ScalarType::Int);
  check_shape(kOp, "visible_ids", visible_ids_in, {-1});
  const std::int64_t visible = visible_ids_in.size(0);
  if (visible == 0 || strength == 0) return;
  const Tensor quats = as_contiguous(quats_in), scales = as_contiguous(scales_in);
  const Tensor opacities = as_contiguous(opacities_in), ids = as_contiguous(ids_in);
  const Tensor visible_ids = as_contiguous(visible_ids_in);

  DeviceScope scope(means);
  dispatch_floating(means, [&](auto zero) {
    using T = decltype(zero);
    const PositionNoiseArgs<T> args{mutable_data<T>(means),
                                    data<T>(quats),
                                    data<T>(scales),
                                    data<T>(opacities),
                                    data<std::int64_t>(ids),
                                    data<std::int32_t>(visible_ids),
                                    visible,
                                    seed,
                                    step,
                                    threshold,
                                    strength};
    backend::position_noise(args, scope.workspace, scope.stream);
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("position_noise_", TORCH_BOX(&blitzgs::position_noise_)); }
