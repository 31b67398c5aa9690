// SPDX-License-Identifier: Apache-2.0
// The checked groups of arguments that the ops of the projection share.
// blitzgs/ops/projection_types.py builds these groups.
#pragma once
#include <cfloat>
#include <limits>
#include <optional>
#include <vector>

#include "common/op.h"
#include "project/project.h"

namespace blitzgs {

using OptionalTensor = std::optional<Tensor>;
using TensorList = std::vector<Tensor>;
using OptionalTensorList = std::vector<OptionalTensor>;
using IntList = std::vector<std::int64_t>;
using FloatList = std::vector<double>;

// Checks the number of entries of a group of arguments. names: those of the entries, for the message.
template <class List>
void check_group(const char* op, const char* names, const List& list, std::size_t least, std::size_t most) {
  STD_TORCH_CHECK(list.size() >= least && list.size() <= most, "blitzgs::", op, ": expected ", names,
                  ", got ", list.size(), " entries");
}

// ints: width, height, tile_size, sh_degree, antialiased, raw. floats: near_plane, far_plane, eps2d,
// radius_clip and, with smooth levels, the floats of set_fade.
inline ProjectOptions<double> checked_options(const char* op, const IntList& ints, const FloatList& floats) {
  check_group(op, "(width, height, tile_size, sh_degree, antialiased, raw)", ints, 6, 6);
  check_group(op, "(near_plane, far_plane, eps2d, radius_clip[, fade_slope, reach of each level])", floats, 4,
              5 + kMaxLevels);
  const std::int64_t width = ints[0], height = ints[1], tile_size = ints[2];
  STD_TORCH_CHECK(width > 0 && height > 0 && width < (1 << 24) && height < (1 << 24), "blitzgs::", op,
                  ": width and height must be in [1, 2^24), got ", width, " x ", height);
  STD_TORCH_CHECK(tile_size > 0 && tile_size < (1 << 24), "blitzgs::", op,
                  ": tile_size must be in [1, 2^24), got ", tile_size);
  // NaN fails each of these comparisons.
  STD_TORCH_CHECK(floats[0] < floats[1], "blitzgs::", op, ": near_plane must be less than far_plane, got ",
                  floats[0], " and ", floats[1]);
  STD_TORCH_CHECK(floats[2] >= 0 && floats[2] <= FLT_MAX && floats[3] >= 0, "blitzgs::", op,
                  ": eps2d must be finite, and eps2d and radius_clip at least 0, got ", floats[2], " and ",
                  floats[3]);
  ProjectOptions<double> options{};
  options.width = static_cast<int>(width);
  options.height = static_cast<int>(height);
  options.tile_size = static_cast<int>(tile_size);
  options.sh_degree = static_cast<int>(ints[3]);
  options.antialiased = ints[4] != 0;
  options.raw = ints[5] != 0;
  options.near_plane = floats[0];
  options.far_plane = floats[1];
  options.eps2d = floats[2];
  options.radius_clip = floats[3];
  options.fade_slope = floats.size() > 4 ? floats[4] : 0.0;
  return options;
}

// Sets the parameters of smooth levels. The floats from the fifth on are f / (f - 1), then for each level the
// distance from which on its weight is 0 (infinite: the level never fades; negative: its weight is 0
// everywhere).
inline void set_fade(const char* op, const Tensor& level, const FloatList& floats, LevelFade& fade) {
  STD_TORCH_CHECK(floats.size() > 5 && floats[4] >= 1, "blitzgs::", op,
                  ": levels need a fade_slope of at least 1 and a reach for each level behind the other "
                  "floats, got ",
                  floats.size(), " floats");
  fade.level = data<std::uint8_t>(level);
  fade.n_levels = static_cast<int>(floats.size()) - 5;
  for (int i = 0; i < fade.n_levels; ++i) {
    const double reach = floats[5 + i];
    fade.inverse_reach2[i] = reach > 0 ? static_cast<float>(1.0 / (reach * reach)) : FLT_MAX;
  }
}

// Gaussians (means, quats, scales, opacities[, sh]) and cameras (viewmats, Ks), contiguous and checked. The
// object holds the tensors, so that the raw pointers stay valid.
struct ProjectArguments {
  Tensor means, quats, scales, opacities, viewmats, Ks;
  OptionalTensor sh, level;
  std::int64_t count, n_views, sh_stride = 0;
  ProjectOptions<double> options;
  LevelFade fade{};

  // level_in: the octree levels of the Gaussians, with smooth levels.
  ProjectArguments(const char* op, const TensorList& gaussians, const TensorList& cameras,
                   const IntList& ints, const FloatList& floats, const OptionalTensor& level_in)
      : options(checked_options(op, ints, floats)) {
    check_group(op, "(means, quats, scales, opacities[, sh])", gaussians, 4, 5);
    check_group(op, "(viewmats, Ks)", cameras, 2, 2);
    check_floating(op, "means", gaussians[0]);
    const ScalarType dtype = gaussians[0].scalar_type();
    means = checked(op, "means", gaussians[0], dtype, {-1, 3});
    count = means.size(0);
    quats = checked(op, "quats", gaussians[1], dtype, {count, 4});
    scales = checked(op, "scales", gaussians[2], dtype, {count, 3});
    opacities = checked(op, "opacities", gaussians[3], dtype, {count});
    viewmats = checked(op, "viewmats", cameras[0], dtype, {-1, 4, 4});
    n_views = viewmats.size(0);
    Ks = checked(op, "Ks", cameras[1], dtype, {n_views, 3, 3});
    STD_TORCH_CHECK(n_views <= kMaxViews, "blitzgs::", op, ": at most ", kMaxViews,
                    " views in one launch, got ", n_views, "; call it for fewer views at a time");
    STD_TORCH_CHECK(count <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op,
                    ": at most 2^31 - 1 Gaussians on one device, got ", count);
    if (gaussians.size() == 5) set_sh(op, gaussians[4]);
    level = checked(op, "level", level_in, ScalarType::Byte, {count});
    if (level) set_fade(op, *level, floats, fade);
  }

  template <class T>
  ProjectInputs<T> inputs() const {
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
            static_cast<int>(n_views),
            {o.width, o.height, o.tile_size, o.sh_degree, o.sh_stride, static_cast<T>(o.near_plane),
             static_cast<T>(o.far_plane), static_cast<T>(o.eps2d), static_cast<T>(o.radius_clip),
             o.antialiased, o.raw, static_cast<T>(o.fade_slope)},
            nullptr,
            fade};
  }

 private:
  void set_sh(const char* op, const Tensor& sh_in) {
    sh = checked(op, "sh", sh_in, means.scalar_type(), {count, -1, 3});
    sh_stride = sh->size(1);
    options.sh_stride = static_cast<int>(sh_stride);
    STD_TORCH_CHECK(options.sh_degree >= 0 && options.sh_degree <= kMaxShDegree, "blitzgs::", op,
                    ": sh_degree must be 0 to 3, got ", options.sh_degree);
    STD_TORCH_CHECK(sh_basis_count(options.sh_degree) <= sh_stride, "blitzgs::", op, ": sh has ", sh_stride,
                    " coefficients, sh_degree ", options.sh_degree, " needs ",
                    sh_basis_count(options.sh_degree));
  }
};

}  // namespace blitzgs
