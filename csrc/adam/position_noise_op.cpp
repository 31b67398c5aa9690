// SPDX-License-Identifier: Apache-2.0
#include "adam/position_noise.h"

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
  const Tensor quats = checked(kOp, "quats", quats_in, dtype, {rows, 4}),
               scales = checked(kOp, "scales", scales_in, dtype, {rows, 3}),
               opacities = checked(kOp, "opacities", opacities_in, dtype, {rows}),
               ids = checked(kOp, "ids", ids_in, ScalarType::Long, {rows}),
               visible_ids = checked(kOp, "visible_ids", visible_ids_in, ScalarType::Int, {-1});
  const std::int64_t visible = visible_ids.size(0);
  if (visible == 0 || strength == 0) return;

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
