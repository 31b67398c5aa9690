// SPDX-License-Identifier: Apache-2.0
#include <tuple>

#include "lazy_adam/lazy_adam_op.h"
#include "project/project_op.h"
#include "project/project_step.h"
#include "project/splat_gradients_op.h"

namespace blitzgs {
namespace {

// What both ops know of the forward pass: (camera_ids, visible_ids, splat_offsets). Held here so that the raw
// pointers stay valid.
struct BackwardSplats {
  Tensor camera_ids, visible_ids, splat_offsets;
  OptionalTensor scale_reg, opacity_reg;

  BackwardSplats(const char* op, const ProjectArguments& p, const TensorList& splats,
                 const OptionalTensor& scale_reg_in, const OptionalTensor& opacity_reg_in)
      : scale_reg(contiguous_or_none(scale_reg_in)), opacity_reg(contiguous_or_none(opacity_reg_in)) {
    check_group(op, "(camera_ids, visible_ids, splat_offsets)", splats, 3, 3);
    camera_ids = as_contiguous(splats[0]);
    visible_ids = as_contiguous(splats[1]);
    splat_offsets = as_contiguous(splats[2]);
    check_dtype(op, "camera_ids", camera_ids, ScalarType::Int);
    check_dtype(op, "visible_ids", visible_ids, ScalarType::Int);
    check_dtype(op, "splat_offsets", splat_offsets, ScalarType::Int);
    check_shape(op, "splat_offsets", splat_offsets, {visible() + 1});
    check_weights(op, p, "scale_reg", scale_reg);
    check_weights(op, p, "opacity_reg", opacity_reg);
  }

  std::int64_t visible() const { return visible_ids.numel(); }
  std::int64_t count() const { return camera_ids.numel(); }
  SplatIndex pointers() const {
    return {data<std::int32_t>(camera_ids), data<std::int32_t>(visible_ids),
            data<std::int32_t>(splat_offsets), visible()};
  }
  template <class T>
  Regularisers<T> regularisers() const {
    return {data_or_null<T>(scale_reg), data_or_null<T>(opacity_reg)};
  }

 private:
  static void check_weights(const char* op, const ProjectArguments& p, const char* name,
                            const OptionalTensor& weights) {
    if (!weights) return;
    check_shape(op, name, *weights, {p.n_views});
    check_dtype(op, name, *weights, p.means.scalar_type());
  }
};

using BackwardTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

BackwardTensors project_bwd(const TensorList& gaussians, const TensorList& cameras, const TensorList& splats,
                            const IntList& ints, const FloatList& floats, const TensorList& v_splats,
                            const OptionalTensor& v_depths, const OptionalTensor& scale_reg,
                            bool need_viewmats, bool dense, const OptionalTensor& opacity_reg,
                            const OptionalTensor& level) {
  constexpr const char* kOp = "project_bwd";
  const ProjectArguments p(kOp, gaussians, cameras, ints, floats, level);
  const BackwardSplats b(kOp, p, splats, scale_reg, opacity_reg);
  const HeldSplatGradients v(kOp, p.means.scalar_type(), b.count(), v_splats, v_depths, std::nullopt,
                             std::nullopt);
  const std::int64_t length = dense ? p.count : b.visible();
  const auto of_visible = [&](const std::vector<std::int64_t>& shape) {
    Tensor gradient = make_empty(p.means, shape);
    if (dense) TORCH_ERROR_CODE_CHECK(aoti_torch_zero_(gradient.get()));
    return gradient;
  };
  Tensor v_means = of_visible({length, 3}), v_quats = of_visible({length, 4}),
         v_scales = of_visible({length, 3}), v_opacities = of_visible({length}),
         v_sh = of_visible({length, p.sh_stride, 3}),
         v_viewmats = make_empty(p.means, {need_viewmats ? p.n_views : 0, 4, 4});
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    backend::project_bwd(
        p.inputs<T>(), b.pointers(), v.source<T>(), b.regularisers<T>(),
        ProjectGradients<T>{mutable_data<T>(v_means), mutable_data<T>(v_quats), mutable_data<T>(v_scales),
                            mutable_data<T>(v_opacities), p.sh ? mutable_data<T>(v_sh) : nullptr,
                            need_viewmats ? mutable_data<T>(v_viewmats) : nullptr, dense},
        scope.workspace, scope.stream);
  });
  return {v_means, v_quats, v_scales, v_opacities, v_sh, v_viewmats};
}

void project_bwd_step(TensorList params, TensorList exp_avgs, TensorList exp_avg_sqs, TensorList last_steps,
                      const TensorList& tables, const IntList& steps, const FloatList& decays,
                      const TensorList& cameras, const TensorList& splats, const IntList& ints,
                      const FloatList& floats, const TensorList& v_splats, const OptionalTensor& places,
                      const OptionalTensor& scale_reg, const OptionalTensor& means2d_sums,
                      const OptionalTensor& opacity_reg, const OptionalTensor& level, bool absolute_sums) {
  constexpr const char* kOp = "project_bwd_step_";
  AdamTensors state(kOp, params, exp_avgs, exp_avg_sqs, last_steps, tables, steps, decays);
  STD_TORCH_CHECK(state.step >= 1, "blitzgs::project_bwd_step_: steps count from 1, got ", state.step);
  const ProjectArguments p(kOp, params, cameras, ints, floats, level);
  const BackwardSplats b(kOp, p, splats, scale_reg, opacity_reg);
  const HeldSplatGradients v(kOp, p.means.scalar_type(), b.count(), v_splats, std::nullopt, places,
                             means2d_sums, absolute_sums);
  if (b.visible() == 0) return;
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    backend::project_bwd_step(p.inputs<T>(), b.pointers(), v.source<T>(), b.regularisers<T>(),
                              state.arguments<T>(data<std::int32_t>(b.visible_ids), b.visible()),
                              scope.workspace, scope.stream);
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("project_bwd", TORCH_BOX(&blitzgs::project_bwd));
  m.impl("project_bwd_step_", TORCH_BOX(&blitzgs::project_bwd_step));
}
