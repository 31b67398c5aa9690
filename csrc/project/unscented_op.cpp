// SPDX-License-Identifier: Apache-2.0
#include "project/unscented.h"

#include "project/project_op.h"

namespace blitzgs {
namespace {

// The checked arguments that the three ops share. The object holds the tensors of its inputs.
struct UnscentedArguments {
  ProjectArguments p;
  Tensor lenses;
  OptionalTensor viewmats_rs;
  UnscentedOptions options;

  // transform: alpha, beta, kappa, margin, and whether all points have to be valid.
  UnscentedArguments(const TensorList& gaussians, const Tensor& viewmats, const Tensor& Ks,
                     const Tensor& lenses_in, const OptionalTensor& viewmats_rs_in, bool fisheye,
                     int64_t shutter, const FloatList& transform, const ProjectOptions<double>& image)
      : p(gaussians, viewmats, Ks, image) {
    const ScalarType dtype = p.means.scalar_type();
    lenses = checked("lenses", lenses_in, dtype, {p.n_views, kLensNumbers});
    viewmats_rs = checked("viewmats_rs", viewmats_rs_in, dtype, {p.n_views, 4, 4});
    BLITZGS_CHECK(shutter >= 0 && shutter <= int(Shutter::kGlobal), "shutter must be 0 to 4, got ", shutter);
    options.shutter = static_cast<Shutter>(shutter);
    BLITZGS_CHECK(viewmats_rs.has_value() == (options.shutter != Shutter::kGlobal),
                  "a rolling shutter needs viewmats_rs, and a global one (4) none");
    check_group("(alpha, beta, kappa, margin, all_valid)", transform, 5, 5);
    const double alpha2 = transform[0] * transform[0], n = alpha2 * (3 + transform[2]);
    BLITZGS_CHECK(n > 0 && std::isfinite(n), "alpha^2 (3 + kappa) must be positive, got ", n);
    options.fisheye = fisheye;
    options.margin = transform[3];
    options.all_valid = transform[4] != 0;
    options.spread = std::sqrt(n);
    options.weight = 0.5 / n;
    options.beyond = transform[1] - alpha2;
  }

  template <class T> UnscentedInputs<T> inputs() const {
    return {p.inputs<T>(), data<T>(lenses), data_or_null<T>(viewmats_rs), options};
  }
};

#define BLITZGS_UNSCENTED                                                                           \
  const TensorList &gaussians, const Tensor &viewmats, const Tensor &Ks, const Tensor &lenses,      \
      const OptionalTensor &viewmats_rs, bool fisheye, int64_t shutter, const FloatList &transform, \
      BLITZGS_PROJECT_OPTIONS
#define BLITZGS_UNSCENTED_CHECKED                                            \
  gaussians, viewmats, Ks, lenses, viewmats_rs, fisheye, shutter, transform, \
      checked_options(BLITZGS_PROJECT_OPTION_NAMES, {})

Tensor unscented_visible(BLITZGS_UNSCENTED) {
  const UnscentedArguments a(BLITZGS_UNSCENTED_CHECKED);
  const int64_t rows = a.p.count * a.p.n_views;
  const auto seen = make<bool>(a.p.means, {a.p.count, a.p.n_views});
  dispatch_floating(a.p.means,
                    [&]<class T>() { run_rows(a.p.means, UnscentedVisible<T>{a.inputs<T>(), seen, rows}); });
  return seen;
}

Tensors<7> unscented_fwd(BLITZGS_UNSCENTED, const Tensor& gaussian_ids_in, const Tensor& camera_ids_in,
                         const Tensor&) {
  const UnscentedArguments a(BLITZGS_UNSCENTED_CHECKED);
  const auto gaussian_ids = checked<int32_t>("gaussian_ids", gaussian_ids_in, {-1});
  const int64_t P = gaussian_ids.numel();
  const auto camera_ids = checked<int32_t>("camera_ids", camera_ids_in, {P});
  const Tensor& like = a.p.means;
  const auto radii = make<int32_t>(like, {P, 2}), tiles = make<int32_t>(like, {P});
  return dispatch_floating(like, [&]<class T>() -> Tensors<7> {
    const auto means2d = make<T>(like, {P, 2}), conics = make<T>(like, {P, 3}), depths = make<T>(like, {P}),
               opacities = make<T>(like, {P}), colors = make<T>(like, {a.p.sh ? P : 0, 3});
    const ProjectOutputs<T> out{means2d, conics, depths,  opacities, colors,
                                radii,   tiles,  nullptr, nullptr,   nullptr};
    run_rows(like, UnscentedSplats<T>{a.inputs<T>(), gaussian_ids, camera_ids, out, P});
    return {means2d, conics, depths, opacities, colors, radii, tiles};
  });
}

// v_splats: the gradients of means2d, conics, depths, opacities[, colors].
Tensors<5> unscented_bwd(BLITZGS_UNSCENTED, const Tensor& camera_ids_in, const Tensor& offsets_in,
                         const TensorList& v_splats) {
  const UnscentedArguments a(BLITZGS_UNSCENTED_CHECKED);
  const int64_t N = a.p.count;
  const auto camera_ids = checked<int32_t>("camera_ids", camera_ids_in, {-1}),
             offsets = checked<int32_t>("splat_offsets", offsets_in, {N + 1});
  const int64_t P = camera_ids.numel();
  const Tensor& like = a.p.means;
  const size_t columns = a.p.sh ? 5 : 4;
  check_group("(v_means2d, v_conics, v_depths, v_opacities[, v_colors])", v_splats, columns, columns);
  return dispatch_floating(like, [&]<class T>() -> Tensors<5> {
    const auto v_means2d = checked<T>("v_means2d", v_splats[0], {P, 2}),
               v_conics = checked<T>("v_conics", v_splats[1], {P, 3}),
               v_depths = checked<T>("v_depths", v_splats[2], {P}),
               v_opacities = checked<T>("v_opacities", v_splats[3], {P});
    const auto v_colors = checked<T>("v_colors", a.p.sh ? OptionalTensor(v_splats[4]) : std::nullopt, {P, 3});
    const auto means = make<T>(like, {N, 3}), quats = make<T>(like, {N, 4}), scales = make<T>(like, {N, 3}),
               opacities = make<T>(like, {N}), sh = make<T>(like, {N, a.p.sh_stride, 3});
    const SplatGradientColumns<T> v{v_means2d, v_conics, v_depths, v_opacities, v_colors};
    const ProjectGradients<T> out{means, quats, scales, opacities, sh, nullptr};
    run_rows(like, UnscentedGradients<T>{a.inputs<T>(), camera_ids, offsets, v, out, N});
    return {means, quats, scales, opacities, sh};
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "unscented_visible", unscented_visible);
  BLITZGS_OP(m, "unscented_fwd", unscented_fwd);
  BLITZGS_OP(m, "unscented_bwd", unscented_bwd);
}
