// SPDX-License-Identifier: Apache-2.0
#include "project/unscented.h"

#include <cmath>
#include <optional>
#include <tuple>

#include "common/op.h"
#include "common/rows.h"
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
  UnscentedArguments(const char* op, const TensorList& gaussians, const Tensor& viewmats, const Tensor& Ks,
                     const Tensor& lenses_in, const OptionalTensor& viewmats_rs_in, bool fisheye,
                     std::int64_t shutter, const FloatList& transform, const ProjectOptions<double>& image)
      : p(op, gaussians, viewmats, Ks, image) {
    const ScalarType dtype = p.means.scalar_type();
    lenses = checked(op, "lenses", lenses_in, dtype, {p.n_views, kLensNumbers});
    viewmats_rs = checked(op, "viewmats_rs", viewmats_rs_in, dtype, {p.n_views, 4, 4});
    BLITZGS_CHECK(shutter >= 0 && shutter <= static_cast<int>(Shutter::kGlobal), op,
                  "shutter must be 0 to 4, got ", shutter);
    options.shutter = static_cast<Shutter>(shutter);
    BLITZGS_CHECK(viewmats_rs.has_value() == (options.shutter != Shutter::kGlobal), op,
                  "a rolling shutter needs viewmats_rs, and a global one (4) none");
    check_group(op, "(alpha, beta, kappa, margin, all_valid)", transform, 5, 5);
    const double alpha2 = transform[0] * transform[0], n = alpha2 * (3 + transform[2]);
    BLITZGS_CHECK(n > 0 && std::isfinite(n), op, "alpha^2 (3 + kappa) must be positive, got ", n);
    options.fisheye = fisheye;
    options.margin = transform[3];
    options.all_valid = transform[4] != 0;
    options.spread = std::sqrt(n);
    options.weight = 0.5 / n;
    options.beyond = transform[1] - alpha2;
  }

  template <class T>
  UnscentedInputs<T> inputs() const {
    return {p.inputs<T>(), data<T>(lenses), data_or_null<T>(viewmats_rs), options};
  }
};

#define BLITZGS_UNSCENTED                                                                                \
  const TensorList &gaussians, const Tensor &viewmats, const Tensor &Ks, const Tensor &lenses,           \
      const OptionalTensor &viewmats_rs, bool fisheye, std::int64_t shutter, const FloatList &transform, \
      std::int64_t width, std::int64_t height, std::int64_t tile_size, std::int64_t sh_degree,           \
      double near_plane, double far_plane, double eps2d, double radius_clip, bool antialiased, bool raw
#define BLITZGS_UNSCENTED_CHECKED(op)                                                                     \
  op, gaussians, viewmats, Ks, lenses, viewmats_rs, fisheye, shutter, transform,                          \
      checked_options(op, width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, \
                      antialiased, raw, {})

Tensor unscented_visible(BLITZGS_UNSCENTED) {
  const UnscentedArguments a(BLITZGS_UNSCENTED_CHECKED("unscented_visible"));
  const std::int64_t rows = a.p.count * a.p.n_views;
  Tensor seen = make_empty(a.p.means, {a.p.count, a.p.n_views}, ScalarType::Bool);
  DeviceScope scope(a.p.means);
  dispatch_floating(a.p.means, [&]<class T>() {
    backend::for_each_row(UnscentedVisible<T>{a.inputs<T>(), mutable_data<bool>(seen), rows}, scope.stream);
  });
  return seen;
}

using Values = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

Values unscented_fwd(BLITZGS_UNSCENTED, const Tensor& gaussian_ids_in, const Tensor& camera_ids_in,
                     const Tensor&) {
  constexpr const char* kOp = "unscented_fwd";
  const UnscentedArguments a(BLITZGS_UNSCENTED_CHECKED(kOp));
  const Tensor gaussian_ids = checked(kOp, "gaussian_ids", gaussian_ids_in, ScalarType::Int, {-1});
  const std::int64_t P = gaussian_ids.numel();
  const Tensor camera_ids = checked(kOp, "camera_ids", camera_ids_in, ScalarType::Int, {P});
  const Tensor& like = a.p.means;
  Tensor means2d = make_empty(like, {P, 2}), conics = make_empty(like, {P, 3}),
         depths = make_empty(like, {P}), opacities = make_empty(like, {P}),
         colors = make_empty(like, {a.p.sh ? P : 0, 3}), radii = make_empty(like, {P, 2}, ScalarType::Int),
         tiles = make_empty(like, {P}, ScalarType::Int);
  DeviceScope scope(like);
  dispatch_floating(like, [&]<class T>() {
    const ProjectOutputs<T> out{mutable_data<T>(means2d),
                                mutable_data<T>(conics),
                                mutable_data<T>(depths),
                                mutable_data<T>(opacities),
                                mutable_data<T>(colors),
                                mutable_data<std::int32_t>(radii),
                                mutable_data<std::int32_t>(tiles),
                                nullptr,
                                nullptr,
                                nullptr};
    backend::for_each_row(UnscentedSplats<T>{a.inputs<T>(), data<std::int32_t>(gaussian_ids),
                                             data<std::int32_t>(camera_ids), out, P},
                          scope.stream);
  });
  return {means2d, conics, depths, opacities, colors, radii, tiles};
}

using Gradients = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;

// v_splats: the gradients of means2d, conics, depths, opacities[, colors].
Gradients unscented_bwd(BLITZGS_UNSCENTED, const Tensor& camera_ids_in, const Tensor& offsets_in,
                        const TensorList& v_splats) {
  constexpr const char* kOp = "unscented_bwd";
  const UnscentedArguments a(BLITZGS_UNSCENTED_CHECKED(kOp));
  const std::int64_t N = a.p.count;
  const Tensor camera_ids = checked(kOp, "camera_ids", camera_ids_in, ScalarType::Int, {-1});
  const Tensor offsets = checked(kOp, "splat_offsets", offsets_in, ScalarType::Int, {N + 1});
  const std::int64_t P = camera_ids.numel();
  const Tensor& like = a.p.means;
  const ScalarType dtype = like.scalar_type();
  const std::size_t columns = a.p.sh ? 5 : 4;
  check_group(kOp, "(v_means2d, v_conics, v_depths, v_opacities[, v_colors])", v_splats, columns, columns);
  const Tensor v_means2d = checked(kOp, "v_means2d", v_splats[0], dtype, {P, 2}),
               v_conics = checked(kOp, "v_conics", v_splats[1], dtype, {P, 3}),
               v_depths = checked(kOp, "v_depths", v_splats[2], dtype, {P}),
               v_opacities = checked(kOp, "v_opacities", v_splats[3], dtype, {P});
  OptionalTensor v_colors;
  if (a.p.sh) v_colors = checked(kOp, "v_colors", v_splats[4], dtype, {P, 3});
  Tensor means = make_empty(like, {N, 3}), quats = make_empty(like, {N, 4}),
         scales = make_empty(like, {N, 3}), opacities = make_empty(like, {N}),
         sh = make_empty(like, {N, a.p.sh_stride, 3});
  DeviceScope scope(like);
  dispatch_floating(like, [&]<class T>() {
    const SplatGradientColumns<T> v{data<T>(v_means2d), data<T>(v_conics), data<T>(v_depths),
                                    data<T>(v_opacities), data_or_null<T>(v_colors)};
    const ProjectGradients<T> out{mutable_data<T>(means),     mutable_data<T>(quats), mutable_data<T>(scales),
                                  mutable_data<T>(opacities), mutable_data<T>(sh),    nullptr};
    backend::for_each_row(UnscentedGradients<T>{a.inputs<T>(), data<std::int32_t>(camera_ids),
                                                data<std::int32_t>(offsets), v, out, N},
                          scope.stream);
  });
  return {means, quats, scales, opacities, sh};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("unscented_visible", TORCH_BOX(&blitzgs::unscented_visible));
  m.impl("unscented_fwd", TORCH_BOX(&blitzgs::unscented_fwd));
  m.impl("unscented_bwd", TORCH_BOX(&blitzgs::unscented_bwd));
}
