// SPDX-License-Identifier: Apache-2.0
#include <tuple>
#include <vector>

#include "lazy_adam/lazy_adam_op.h"
#include "project/project_op.h"
#include "project/project_step.h"
#include "project/row_gradients_op.h"

namespace blitzgs {
namespace {

// The arguments that both ops share, contiguous and checked. Held here so that the raw pointers stay valid.
struct Backward {
  Parameters p;
  Tensor camera_ids, visible_ids, row_offsets;
  OptionalTensor scale_reg;
  ProjectOptions<double> options;

  Backward(const char* op, const Parameters& parameters, const Tensor& camera_ids_in,
           const Tensor& visible_ids_in, const Tensor& row_offsets_in, std::int64_t width,
           std::int64_t height, std::int64_t sh_degree, double eps2d, bool antialiased, bool raw,
           const OptionalTensor& scale_reg_in)
      : p(parameters),
        camera_ids(as_contiguous(camera_ids_in)),
        visible_ids(as_contiguous(visible_ids_in)),
        row_offsets(as_contiguous(row_offsets_in)),
        scale_reg(contiguous_or_none(scale_reg_in)),
        options{} {
    check_image(op, width, height);
    check_dtype(op, "camera_ids", camera_ids, ScalarType::Int);
    check_dtype(op, "visible_ids", visible_ids, ScalarType::Int);
    check_dtype(op, "row_offsets", row_offsets, ScalarType::Int);
    check_shape(op, "row_offsets", row_offsets, {visible() + 1});
    if (scale_reg) {
      check_shape(op, "scale_reg", *scale_reg, {p.n_views});
      check_dtype(op, "scale_reg", *scale_reg, p.means.scalar_type());
    }
    options.width = static_cast<int>(width);
    options.height = static_cast<int>(height);
    options.sh_degree = static_cast<int>(sh_degree);
    options.sh_stride = static_cast<int>(p.sh_stride);
    options.eps2d = eps2d;
    options.antialiased = antialiased;
    options.raw = raw;
  }

  std::int64_t visible() const { return visible_ids.numel(); }

  template <class T>
  ProjectInputs<T> inputs() const {
    ProjectOptions<T> o{};
    o.width = options.width;
    o.height = options.height;
    o.sh_degree = options.sh_degree;
    o.sh_stride = options.sh_stride;
    o.eps2d = static_cast<T>(options.eps2d);
    o.antialiased = options.antialiased;
    o.raw = options.raw;
    return p.inputs<T>(o);
  }
  ProjectRows rows() const {
    return {data<std::int32_t>(camera_ids), data<std::int32_t>(visible_ids), data<std::int32_t>(row_offsets),
            visible()};
  }
};

using BackwardTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

BackwardTensors project_bwd(
    const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
    const OptionalTensor& sh, const Tensor& viewmats, const Tensor& Ks, const Tensor& camera_ids,
    const Tensor& visible_ids, const Tensor& row_offsets, std::int64_t width, std::int64_t height,
    std::int64_t sh_degree, double eps2d, bool antialiased, bool raw, const OptionalTensor& v_means2d,
    const OptionalTensor& v_conics, const OptionalTensor& v_depths, const OptionalTensor& v_row_opacities,
    const OptionalTensor& v_colors, const OptionalTensor& scale_reg, bool need_viewmats,
    const OptionalTensor& places, const std::vector<std::int64_t>& group_sizes,
    const std::vector<std::int64_t>& starts, const std::optional<std::vector<Tensor>>& buffers,
    std::int64_t offset, bool dense) {
  constexpr const char* kOp = "project_bwd";
  const Parameters p(kOp, means, quats, scales, opacities, sh, viewmats, Ks, sh_degree);
  const Backward b(kOp, p, camera_ids, visible_ids, row_offsets, width, height, sh_degree, eps2d, antialiased,
                   raw, scale_reg);
  HeldRowGradients v(kOp, p.means.scalar_type(), camera_ids.numel(), v_means2d, v_conics, v_depths,
                     v_row_opacities, v_colors, {places, group_sizes, starts, buffers, offset}, std::nullopt);
  const std::int64_t length = dense ? p.count : b.visible();
  const auto rows_of = [&](std::vector<std::int64_t> shape) {
    Tensor rows = make_empty(p.means, shape);
    if (dense) TORCH_ERROR_CODE_CHECK(aoti_torch_zero_(rows.get()));
    return rows;
  };
  Tensor v_means = rows_of({length, 3}), v_quats = rows_of({length, 4}), v_scales = rows_of({length, 3}),
         v_opacities = rows_of({length}), v_sh = rows_of({length, p.sh_stride, 3}),
         v_viewmats = make_empty(p.means, {need_viewmats ? p.n_views : 0, 4, 4});
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    backend::project_bwd(
        b.inputs<T>(), b.rows(), v.source<T>(), data_or_null<T>(b.scale_reg),
        ProjectGradients<T>{mutable_data<T>(v_means), mutable_data<T>(v_quats), mutable_data<T>(v_scales),
                            mutable_data<T>(v_opacities), sh ? mutable_data<T>(v_sh) : nullptr,
                            need_viewmats ? mutable_data<T>(v_viewmats) : nullptr, dense},
        scope.workspace, scope.stream);
  });
  return {v_means, v_quats, v_scales, v_opacities, v_sh, v_viewmats};
}

void project_bwd_step_(std::vector<Tensor> params, std::vector<Tensor> exp_avgs,
                       std::vector<Tensor> exp_avg_sqs, Tensor last_step, Tensor moment_step,
                       const Tensor& table, const Tensor& lr_table, std::int64_t step,
                       std::int64_t explicit_steps, double beta1, double beta2, double eps, bool sparse,
                       const Tensor& viewmats, const Tensor& Ks, const Tensor& camera_ids,
                       const Tensor& visible_ids, const Tensor& row_offsets, std::int64_t width,
                       std::int64_t height, std::int64_t sh_degree, double eps2d, bool antialiased,
                       const OptionalTensor& v_means2d, const OptionalTensor& v_conics,
                       const OptionalTensor& v_row_opacities, const OptionalTensor& v_colors,
                       const OptionalTensor& scale_reg, const OptionalTensor& places,
                       const std::vector<std::int64_t>& group_sizes, const std::vector<std::int64_t>& starts,
                       const std::optional<std::vector<Tensor>>& buffers, std::int64_t offset,
                       const OptionalTensor& means2d_sums) {
  constexpr const char* kOp = "project_bwd_step_";
  AdamTensors state{kOp,      params, exp_avgs,       exp_avg_sqs, last_step, moment_step, table,
                    lr_table, step,   explicit_steps, beta1,       beta2,     eps,         sparse};
  state.check();
  STD_TORCH_CHECK(step >= 1, "blitzgs::project_bwd_step_: steps count from 1, got ", step);
  const Parameters p(kOp, params[0], params[1], params[2], params[3], params[4], viewmats, Ks, sh_degree);
  const Backward b(kOp, p, camera_ids, visible_ids, row_offsets, width, height, sh_degree, eps2d, antialiased,
                   true, scale_reg);
  HeldRowGradients v(kOp, p.means.scalar_type(), camera_ids.numel(), v_means2d, v_conics, std::nullopt,
                     v_row_opacities, v_colors, {places, group_sizes, starts, buffers, offset}, means2d_sums);
  if (b.visible() == 0) return;
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    backend::project_bwd_step(b.inputs<T>(), b.rows(), v.source<T>(), data_or_null<T>(b.scale_reg),
                              state.arguments<T>(data<std::int32_t>(b.visible_ids), b.visible()),
                              scope.workspace, scope.stream);
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("project_bwd", TORCH_BOX(&blitzgs::project_bwd));
  m.impl("project_bwd_step_", TORCH_BOX(&blitzgs::project_bwd_step_));
}
