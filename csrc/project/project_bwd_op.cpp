// SPDX-License-Identifier: Apache-2.0
#include <tuple>
#include <vector>

#include "lazy_adam/lazy_adam_op.h"
#include "project/project_op.h"
#include "project/project_step.h"

namespace blitzgs {
namespace {

// The arguments that both ops share, contiguous and checked. Held here so that the raw pointers stay valid.
struct Backward {
  Parameters p;
  Tensor camera_ids, visible_ids, row_offsets, v_means2d, v_conics, v_opacities;
  OptionalTensor v_depths, v_colors, scale_reg;
  ProjectOptions<double> options;

  Backward(const char* op, const Parameters& parameters, const Tensor& camera_ids_in,
           const Tensor& visible_ids_in, const Tensor& row_offsets_in, std::int64_t width,
           std::int64_t height, std::int64_t sh_degree, double eps2d, bool antialiased, bool raw,
           const Tensor& v_means2d_in, const Tensor& v_conics_in, const OptionalTensor& v_depths_in,
           const Tensor& v_opacities_in, const OptionalTensor& v_colors_in,
           const OptionalTensor& scale_reg_in)
      : p(parameters),
        camera_ids(as_contiguous(camera_ids_in)),
        visible_ids(as_contiguous(visible_ids_in)),
        row_offsets(as_contiguous(row_offsets_in)),
        v_means2d(as_contiguous(v_means2d_in)),
        v_conics(as_contiguous(v_conics_in)),
        v_opacities(as_contiguous(v_opacities_in)),
        v_depths(contiguous_or_none(v_depths_in)),
        v_colors(contiguous_or_none(v_colors_in)),
        scale_reg(contiguous_or_none(scale_reg_in)),
        options{} {
    check_image(op, width, height);
    const std::int64_t U = visible(), P = camera_ids.numel();
    const ScalarType dtype = p.means.scalar_type();
    check_dtype(op, "camera_ids", camera_ids, ScalarType::Int);
    check_dtype(op, "visible_ids", visible_ids, ScalarType::Int);
    check_dtype(op, "row_offsets", row_offsets, ScalarType::Int);
    check_shape(op, "row_offsets", row_offsets, {U + 1});
    check_shape(op, "v_means2d", v_means2d, {P, 2});
    check_shape(op, "v_conics", v_conics, {P, 3});
    check_shape(op, "v_row_opacities", v_opacities, {P});
    if (v_depths) check_shape(op, "v_depths", *v_depths, {P});
    if (v_colors) check_shape(op, "v_colors", *v_colors, {P, 3});
    if (scale_reg) check_shape(op, "scale_reg", *scale_reg, {p.n_views});
    for (const Tensor* v : {&v_means2d, &v_conics, &v_opacities}) check_dtype(op, "row gradients", *v, dtype);
    for (const OptionalTensor* v : {&v_depths, &v_colors, &scale_reg}) {
      if (*v) check_dtype(op, "row gradients and scale_reg", **v, dtype);
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
  template <class T>
  ProjectRowGradients<T> gradients() const {
    return {data<T>(v_means2d), data<T>(v_conics), data_or_null<T>(v_depths), data<T>(v_opacities),
            data_or_null<T>(v_colors)};
  }
};

using BackwardTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

BackwardTensors project_bwd(const Tensor& means, const Tensor& quats, const Tensor& scales,
                            const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats,
                            const Tensor& Ks, const Tensor& camera_ids, const Tensor& visible_ids,
                            const Tensor& row_offsets, std::int64_t width, std::int64_t height,
                            std::int64_t sh_degree, double eps2d, bool antialiased, bool raw,
                            const Tensor& v_means2d, const Tensor& v_conics, const OptionalTensor& v_depths,
                            const Tensor& v_row_opacities, const OptionalTensor& v_colors,
                            const OptionalTensor& scale_reg, bool need_viewmats) {
  constexpr const char* kOp = "project_bwd";
  const Parameters p(kOp, means, quats, scales, opacities, sh, viewmats, Ks, sh_degree);
  const Backward b(kOp, p, camera_ids, visible_ids, row_offsets, width, height, sh_degree, eps2d, antialiased,
                   raw, v_means2d, v_conics, v_depths, v_row_opacities, v_colors, scale_reg);
  const std::int64_t U = b.visible();
  Tensor v_means = make_empty(p.means, {U, 3}), v_quats = make_empty(p.means, {U, 4}),
         v_scales = make_empty(p.means, {U, 3}), v_opacities = make_empty(p.means, {U}),
         v_sh = make_empty(p.means, {U, p.sh_stride, 3}),
         v_viewmats = make_empty(p.means, {need_viewmats ? p.n_views : 0, 4, 4});
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    backend::project_bwd(
        b.inputs<T>(), b.rows(), b.gradients<T>(), data_or_null<T>(b.scale_reg),
        ProjectGradients<T>{mutable_data<T>(v_means), mutable_data<T>(v_quats), mutable_data<T>(v_scales),
                            mutable_data<T>(v_opacities), sh ? mutable_data<T>(v_sh) : nullptr,
                            need_viewmats ? mutable_data<T>(v_viewmats) : nullptr},
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
                       const Tensor& v_means2d, const Tensor& v_conics, const Tensor& v_row_opacities,
                       const Tensor& v_colors, const OptionalTensor& scale_reg) {
  constexpr const char* kOp = "project_bwd_step_";
  AdamTensors state{kOp,      params, exp_avgs,       exp_avg_sqs, last_step, moment_step, table,
                    lr_table, step,   explicit_steps, beta1,       beta2,     eps,         sparse};
  state.check();
  STD_TORCH_CHECK(step >= 1, "blitzgs::project_bwd_step_: steps count from 1, got ", step);
  const Parameters p(kOp, params[0], params[1], params[2], params[3], params[4], viewmats, Ks, sh_degree);
  const Backward b(kOp, p, camera_ids, visible_ids, row_offsets, width, height, sh_degree, eps2d, antialiased,
                   true, v_means2d, v_conics, std::nullopt, v_row_opacities, v_colors, scale_reg);
  if (b.visible() == 0) return;
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    backend::project_bwd_step(b.inputs<T>(), b.rows(), b.gradients<T>(), data_or_null<T>(b.scale_reg),
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
