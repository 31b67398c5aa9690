// SPDX-License-Identifier: Apache-2.0
// The checked groups of arguments that the ops of the projection share.
// blitzgs/ops/projection_types.py builds these groups.
#pragma once
#include <cfloat>

#include "common/op.h"
#include "project/project.h"

namespace blitzgs {

// The options of the projection as the ops take them, and as arguments of checked_options.
#define BLITZGS_PROJECT_OPTIONS                                                                             \
  int64_t width, int64_t height, int64_t tile_size, int64_t sh_degree, double near_plane, double far_plane, \
      double eps2d, double radius_clip, bool antialiased, bool raw
#define BLITZGS_PROJECT_OPTION_NAMES \
  width, height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw

// fade: empty, or the floats of set_fade.
inline ProjectOptions<double> checked_options(BLITZGS_PROJECT_OPTIONS, const FloatList& fade) {
  BLITZGS_CHECK(width > 0 && height > 0 && width < (1 << 24) && height < (1 << 24),
                "width and height must be in [1, 2^24), got ", width, " x ", height);
  BLITZGS_CHECK(tile_size > 0 && tile_size < (1 << 24), "tile_size must be in [1, 2^24), got ", tile_size);
  // NaN fails each of these comparisons.
  BLITZGS_CHECK(near_plane < far_plane, "near_plane must be less than far_plane, got ", near_plane, " and ",
                far_plane);
  BLITZGS_CHECK(eps2d >= 0 && eps2d <= FLT_MAX && radius_clip >= 0,
                "eps2d must be finite, and eps2d and radius_clip at least 0, got ", eps2d, " and ",
                radius_clip);
  check_group("(fade_slope, reach of each level)", fade, 0, 1 + kMaxLevels);
  return {int(width),
          int(height),
          int(tile_size),
          int(sh_degree),
          /*sh_stride=*/0,
          near_plane,
          far_plane,
          eps2d,
          radius_clip,
          antialiased,
          raw,
          fade.empty() ? 0.0 : fade[0]};
}

// Sets the parameters of smooth levels. The numbers are f / (f - 1), then for each level the distance from
// which on its weight is 0 (infinite: the level never fades; negative: its weight is 0 everywhere).
inline void set_fade(const Tensor& level, const FloatList& numbers, LevelFade& fade) {
  BLITZGS_CHECK(numbers.size() > 1 && numbers[0] >= 1,
                "levels need a fade_slope of at least 1 and a reach for each level in fade, got ",
                numbers.size(), " floats");
  fade.level = data<uint8_t>(level);
  fade.n_levels = int(numbers.size()) - 1;
  for (int i = 0; i < fade.n_levels; ++i) {
    const double reach = numbers[1 + i];
    fade.inverse_reach2[i] = reach > 0 ? float(1.0 / (reach * reach)) : FLT_MAX;
  }
}

// Gaussians (means, quats, scales, opacities[, sh]) and cameras, contiguous and checked. The object holds the
// tensors, so that the raw pointers stay valid.
struct ProjectArguments {
  Tensor means, quats, scales, opacities, viewmats, Ks;
  OptionalTensor sh, level;
  int64_t count, n_views, sh_stride = 0;
  ProjectOptions<double> options;
  LevelFade fade{};

  // level_in: the octree levels of the Gaussians, with smooth levels, whose numbers are in `numbers`.
  ProjectArguments(const TensorList& gaussians, const Tensor& viewmats_in, const Tensor& Ks_in,
                   const ProjectOptions<double>& options_in, const FloatList& numbers = {},
                   const OptionalTensor& level_in = std::nullopt)
      : options(options_in) {
    check_group("(means, quats, scales, opacities[, sh])", gaussians, 4, 5);
    check_floating("means", gaussians[0]);
    const ScalarType dtype = gaussians[0].scalar_type();
    means = checked("means", gaussians[0], dtype, {-1, 3});
    count = means.size(0);
    quats = checked("quats", gaussians[1], dtype, {count, 4});
    scales = checked("scales", gaussians[2], dtype, {count, 3});
    opacities = checked("opacities", gaussians[3], dtype, {count});
    viewmats = checked("viewmats", viewmats_in, dtype, {-1, 4, 4});
    n_views = viewmats.size(0);
    Ks = checked("Ks", Ks_in, dtype, {n_views, 3, 3});
    BLITZGS_CHECK(n_views <= kMaxViews, "at most ", kMaxViews, " views in one launch, got ", n_views,
                  "; call it for fewer views at a time");
    BLITZGS_CHECK(count <= INT32_MAX, "at most 2^31 - 1 Gaussians on one device, got ", count);
    if (gaussians.size() == 5) set_sh(gaussians[4]);
    level = checked("level", level_in, ScalarType::Byte, {count});
    if (level) set_fade(*level, numbers, fade);
  }

  template <class T> ProjectInputs<T> inputs() const {
    const ProjectOptions<double>& o = options;
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
            int(n_views),
            {o.width, o.height, o.tile_size, o.sh_degree, o.sh_stride, T(o.near_plane), T(o.far_plane),
             T(o.eps2d), T(o.radius_clip), o.antialiased, o.raw, T(o.fade_slope)},
            nullptr,
            fade};
  }

 private:
  void set_sh(const Tensor& sh_in) {
    sh = checked("sh", sh_in, means.scalar_type(), {count, -1, 3});
    sh_stride = sh->size(1);
    options.sh_stride = int(sh_stride);
    BLITZGS_CHECK(options.sh_degree >= 0 && options.sh_degree <= kMaxShDegree,
                  "sh_degree must be 0 to 3, got ", options.sh_degree);
    BLITZGS_CHECK(sh_basis_count(options.sh_degree) <= sh_stride, "sh has ", sh_stride,
                  " coefficients, sh_degree ", options.sh_degree, " needs ",
                  sh_basis_count(options.sh_degree));
  }
};

}  // namespace blitzgs
