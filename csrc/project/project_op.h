// SPDX-License-Identifier: Apache-2.0
// What the ops of the projection share: checked parameters and views.
#pragma once
#include <limits>
#include <optional>

#include "common/op.h"
#include "project/project.h"

namespace blitzgs {

using OptionalTensor = std::optional<Tensor>;

// The contiguous inputs of both directions, checked. Held here so that the raw pointers stay valid.
struct Parameters {
  Tensor means, quats, scales, opacities, viewmats, Ks;
  OptionalTensor sh;
  std::int64_t count, n_views, sh_stride;

  Parameters(const char* op, const Tensor& means_in, const Tensor& quats_in, const Tensor& scales_in,
             const Tensor& opacities_in, const OptionalTensor& sh_in, const Tensor& viewmats_in,
             const Tensor& Ks_in, std::int64_t sh_degree)
      : means(as_contiguous(means_in)),
        quats(as_contiguous(quats_in)),
        scales(as_contiguous(scales_in)),
        opacities(as_contiguous(opacities_in)),
        viewmats(as_contiguous(viewmats_in)),
        Ks(as_contiguous(Ks_in)),
        sh(sh_in ? OptionalTensor(as_contiguous(*sh_in)) : std::nullopt) {
    check_floating(op, "means", means);
    check_shape(op, "means", means, {-1, 3});
    check_shape(op, "viewmats", viewmats, {-1, 4, 4});
    count = means.size(0);
    n_views = viewmats.size(0);
    sh_stride = sh && sh->dim() == 3 ? sh->size(1) : 0;
    check_shape(op, "quats", quats, {count, 4});
    check_shape(op, "scales", scales, {count, 3});
    check_shape(op, "opacities", opacities, {count});
    check_shape(op, "Ks", Ks, {n_views, 3, 3});
    const ScalarType dtype = means.scalar_type();
    check_dtype(op, "quats", quats, dtype);
    check_dtype(op, "scales", scales, dtype);
    check_dtype(op, "opacities", opacities, dtype);
    check_dtype(op, "viewmats", viewmats, dtype);
    check_dtype(op, "Ks", Ks, dtype);
    STD_TORCH_CHECK(n_views <= kMaxViews, "blitzgs::", op, ": at most ", kMaxViews,
                    " views in one launch, got ", n_views, "; call it for fewer views at a time");
    STD_TORCH_CHECK(count <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op,
                    ": at most 2^31 - 1 Gaussians on one device, got ", count);
    if (sh) {
      check_shape(op, "sh", *sh, {count, -1, 3});
      check_dtype(op, "sh", *sh, dtype);
      STD_TORCH_CHECK(sh_degree >= 0 && sh_degree <= kMaxShDegree, "blitzgs::", op,
                      ": sh_degree must be 0 to 3, got ", sh_degree);
      STD_TORCH_CHECK(sh_basis_count(static_cast<int>(sh_degree)) <= sh_stride, "blitzgs::", op, ": sh has ",
                      sh_stride, " coefficients, sh_degree ", sh_degree, " needs ",
                      sh_basis_count(static_cast<int>(sh_degree)));
    }
  }

  template <class T>
  ProjectInputs<T> inputs(const ProjectOptions<T>& options) const {
    return {data<T>(means),
            data<T>(quats),
            data<T>(scales),
            data<T>(opacities),
            data_or_null<T>(sh),
            data<T>(viewmats),
            data<T>(Ks),
            nullptr,
            nullptr,
            count,
            static_cast<int>(n_views),
            options};
  }
};

inline void check_image(const char* op, std::int64_t width, std::int64_t height) {
  STD_TORCH_CHECK(width > 0 && height > 0 && width < (1 << 24) && height < (1 << 24), "blitzgs::", op,
                  ": width and height must be in [1, 2^24), got ", width, " x ", height);
}

inline OptionalTensor contiguous_or_none(const OptionalTensor& tensor) {
  return tensor ? OptionalTensor(as_contiguous(*tensor)) : std::nullopt;
}

}  // namespace blitzgs
