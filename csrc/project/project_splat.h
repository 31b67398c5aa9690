// SPDX-License-Identifier: Apache-2.0
// The arithmetic of one splat, a Gaussian projected into a view, forward and backward (docs/image.md,
// sections 1, 2 and 4), for both backends. CUDA forward kernels are compiled without FMA contraction, because
// two launches that project the same splat must get the same bits.
#pragma once
#include "math/frustum.h"
#include "math/gaussian.h"
#include "math/projection.h"
#include "math/tiles.h"

namespace blitzgs {

template <class T> struct ProjectOptions {
  int width, height, tile_size;
  int sh_degree, sh_stride;  // sh_stride: coefficients stored per Gaussian, K
  T near_plane, far_plane, eps2d, radius_clip;
  bool antialiased, raw;
  T fade_slope = T(0);  // f / (f - 1) of smooth levels (project.h)
};

// A Gaussian after activation (docs/image.md, section 1). All its splats use the same one.
template <class T> struct ActivatedGaussian {
  Vec3<T> mean, scale;
  UnitQuaternion<T> quat;
  Columns3<T> rotation, axes;
  T opacity;
  T inverse_reach2;  // 1 / reach^2 of its level (project.h); 0: the Gaussian does not fade
};

template <class T> struct Splat {
  T mean2d[2], conic[3], depth, opacity;
  T extent[2];  // half width and height of the box around alpha >= 1/255, px
};

template <class T> BLITZGS_HD Vec3<T> activate_scale(const T* scale, bool raw) {
  if (!raw) return load3(scale);
  return {std::exp(scale[0]), std::exp(scale[1]), std::exp(scale[2])};
}

template <class T> BLITZGS_HD T activate_opacity(T opacity, bool raw) {
  return raw ? sigmoid(opacity) : opacity;
}

// The largest distance from the centre, in standard deviations, at which a splat of this opacity has
// alpha >= 1/255; negative if alpha is smaller everywhere.
template <class T> BLITZGS_HD T visible_sigmas(T opacity) {
  return opacity >= T(kAlphaCut) && is_finite(opacity)
             ? std::sqrt(T(2) * std::log(larger(T(255) * opacity, T(1))))
             : T(-1);
}

template <class T>
BLITZGS_HD bool touches_image(const T* mean2d, T half_x, T half_y, const ProjectOptions<T>& options) {
  return mean2d[0] + half_x > T(0) && mean2d[0] - half_x < T(options.width) && mean2d[1] + half_y > T(0) &&
         mean2d[1] - half_y < T(options.height);
}

template <class T> BLITZGS_HD bool in_depth_range(T depth, const ProjectOptions<T>& options) {
  return depth > options.near_plane && depth <= options.far_plane;
}

template <class T> BLITZGS_HD Frustum frustum_of(const Camera<T>& camera, const ProjectOptions<T>& options) {
  return make_frustum(camera, options.width, options.height, options.near_plane, options.far_plane,
                      options.eps2d);
}

template <class T>
BLITZGS_HD ActivatedGaussian<T> activate_gaussian(const Vec3<T>& mean, const T* quat, const Vec3<T>& scale,
                                                  T opacity, T inverse_reach2 = T(0)) {
  ActivatedGaussian<T> gaussian;
  gaussian.mean = mean;
  gaussian.scale = scale;
  gaussian.quat = normalize_quaternion(quat);
  gaussian.rotation = rotation_columns(gaussian.quat);
  gaussian.axes = scaled_axes(gaussian.rotation, scale);
  gaussian.opacity = opacity;
  gaussian.inverse_reach2 = inverse_reach2;
  return gaussian;
}

// The factor on a Gaussian's opacity in a view with smooth levels (project.h).
template <class T>
BLITZGS_HD T level_weight(const Camera<T>& camera, const ActivatedGaussian<T>& gaussian, T slope) {
  if (!(gaussian.inverse_reach2 > T(0))) return T(1);
  const Vec3<T> offset = gaussian.mean - camera.centre;
  return smaller(larger(slope - slope * gaussian.inverse_reach2 * dot(offset, offset), T(0)), T(1));
}

template <class T> BLITZGS_HD int32_t pixel_radius(T extent) {
  return int32_t(std::ceil(smaller(extent, T(1 << 30))));
}

// Sets the extent of a splat whose other values are known. Returns false if the splat does not exist.
template <class T>
BLITZGS_HD bool bound_splat(const Footprint<T>& footprint, const ProjectOptions<T>& options,
                            Splat<T>* splat) {
  const T sigmas = visible_sigmas(splat->opacity);
  if (sigmas < T(0) || !is_finite(footprint.conic[0] + footprint.conic[1] + footprint.conic[2])) return false;
  splat->extent[0] = sigmas * std::sqrt(footprint.cov_xx);
  splat->extent[1] = sigmas * std::sqrt(footprint.cov_yy);
  // As in gsplat, the rounded radius counts, the one that callers see.
  const T extent = larger(splat->extent[0], splat->extent[1]);
  if (options.radius_clip > T(0) && !(T(pixel_radius(extent)) > options.radius_clip)) return false;
  // The factor 1.0001 makes sure that an extent that was rounded down loses no pixel at the border.
  return touches_image(splat->mean2d, T(1.0001) * splat->extent[0], T(1.0001) * splat->extent[1], options);
}

// Projects a Gaussian into a view (docs/image.md, section 2). Returns false if the splat does not exist, by
// the rules at the top of project.h.
template <class T>
BLITZGS_HD bool project_splat(const Camera<T>& camera, const ActivatedGaussian<T>& gaussian,
                              const ProjectOptions<T>& options, Splat<T>* splat) {
  const ProjectedMean p = project_mean(camera, gaussian.mean);
  splat->depth = T(p.z);
  if (!in_depth_range(splat->depth, options)) return false;
  pixel_position(camera, p, splat->mean2d);
  const Footprint<T> footprint = make_footprint(pixel_gradients(camera, p), gaussian.axes, options.eps2d);
  store_conic(footprint, splat->conic);
  splat->opacity = level_weight(camera, gaussian, options.fade_slope) * gaussian.opacity;
  if (options.antialiased) splat->opacity *= compensation(footprint);
  return bound_splat(footprint, options, splat);
}

// Returns the number of tiles that a splat touches and sets *ranks to the ranks (as bits) that composite some
// of them. Calls f(rank, number of tiles) for each piece of a tile row that one rank composites.
template <class T, class F>
BLITZGS_HD int32_t splat_tiles(const Splat<T>& splat, int view, const ProjectOptions<T>& options,
                               const RankTiles& rank_tiles, int64_t* ranks, const F& f) {
  const int tiles_x = (options.width + options.tile_size - 1) / options.tile_size;
  const int tiles_y = (options.height + options.tile_size - 1) / options.tile_size;
  const int64_t image = int64_t(view) * tiles_x * tiles_y;
  int32_t count = 0;
  int64_t wanted = 0;
  for_each_tile_row(splat.mean2d, splat.conic, splat.opacity, options.width, options.height,
                    options.tile_size, [&](int ty, int begin, int end) {
                      count += end - begin;
                      const int64_t first = image + int64_t(ty) * tiles_x;
                      for_each_rank(rank_tiles, first + begin, first + end, [&](int rank, int64_t tiles) {
                        wanted |= int64_t{1} << rank;
                        f(rank, tiles);
                      });
                    });
  *ranks = wanted;
  return count;
}

// View direction of the SH colour: normalise(mean - camera centre). Returns 1 / distance (0 at the centre).
template <class T>
BLITZGS_HD T view_direction(const Camera<T>& camera, const Vec3<T>& mean, Vec3<T>* direction) {
  const Vec3<T> offset = mean - camera.centre;
  const T squared = dot(offset, offset);
  const T inverse = squared > T(0) ? T(1) / std::sqrt(squared) : T(0);
  *direction = inverse * offset;
  return inverse;
}

// sum_k basis_k sh_k + 0.5; sh [K, 3].
template <class T> BLITZGS_HD Vec3<T> unclipped_color(const T* basis, const T* sh, int degree) {
  Vec3<T> sum{T(0.5), T(0.5), T(0.5)};
  for (int k = 0; k < sh_basis_count(degree); ++k) sum = mul_add(basis[k], load3(sh + 3 * k), sum);
  return sum;
}

template <class T> BLITZGS_HD bool finite_color(const Vec3<T>& color) {
  return is_finite(color.x) && is_finite(color.y) && is_finite(color.z);
}

// color = max(sum_k basis_k sh_k + 0.5, 0); sh [K, 3] (docs/image.md, section 4). Returns false and sets
// color to zeros if the sum is not finite; the caller then hides the splat.
template <class T>
BLITZGS_HD bool splat_color(const Camera<T>& camera, const Vec3<T>& mean, const T* sh, int degree, T* color) {
  Vec3<T> direction;
  view_direction(camera, mean, &direction);
  T basis[kMaxShBasis];
  sh_basis(degree, direction, basis);
  const Vec3<T> sum = unclipped_color(basis, sh, degree);
  const bool shown = finite_color(sum);
  store3(shown ? Vec3<T>{larger(sum.x, T(0)), larger(sum.y, T(0)), larger(sum.z, T(0))} : Vec3<T>{}, color);
  return shown;
}

// Adds the gradients of a splat's colour to v_sh [K, 3], v_mean and pose (null: not wanted). A channel that
// is clipped at 0 and a hidden splat contribute zero.
template <class T>
BLITZGS_HD void splat_color_vjp(const Camera<T>& camera, const Vec3<T>& mean, const T* sh, int degree,
                                const T* v_color, T* v_sh, Vec3<T>* v_mean, PoseGradient<T>* pose) {
  Vec3<T> direction;
  const T inverse_distance = view_direction(camera, mean, &direction);
  T basis[kMaxShBasis], v_basis[kMaxShBasis] = {};
  sh_basis(degree, direction, basis);
  const Vec3<T> sum = unclipped_color(basis, sh, degree);
  if (!finite_color(sum)) return;
  const Vec3<T> v{sum.x > T(0) ? v_color[0] : T(0), sum.y > T(0) ? v_color[1] : T(0),
                  sum.z > T(0) ? v_color[2] : T(0)};
  for (int k = 0; k < sh_basis_count(degree); ++k) {
    store3(load3(v_sh + 3 * k) + basis[k] * v, v_sh + 3 * k);
    v_basis[k] = dot(load3(sh + 3 * k), v);
  }
  const Vec3<T> v_direction = sh_basis_vjp(degree, direction, v_basis);
  const Vec3<T> v_offset = inverse_distance * (v_direction - dot(v_direction, direction) * direction);
  *v_mean = *v_mean + v_offset;
  if (pose) camera_centre_vjp(camera, T(-1) * v_offset, pose);
}

template <class T> struct GeometryGradient {
  T mean2d[2], conic[3], depth, opacity;
};

template <class T> struct GaussianGradient {
  Vec3<T> mean;
  Columns3<T> axes;
  T opacity;
};

// Adds the gradients of one splat's geometry to `gradient` and to pose (null: not wanted). Recomputes the
// intermediate values of the projection.
template <class T>
BLITZGS_HD void project_splat_vjp(const Camera<T>& camera, const ActivatedGaussian<T>& gaussian,
                                  const ProjectOptions<T>& options, const GeometryGradient<T>& v,
                                  GaussianGradient<T>* gradient, PoseGradient<T>* pose) {
  const ProjectedMean p = project_mean(camera, gaussian.mean);
  const PixelGradients<T> g = pixel_gradients(camera, p);
  const Footprint<T> footprint = make_footprint(g, gaussian.axes, options.eps2d);
  const T v_opacity = level_weight(camera, gaussian, options.fade_slope) * v.opacity;
  gradient->opacity += options.antialiased ? v_opacity * compensation(footprint) : v_opacity;
  Vec3<T> v_m0, v_m1, v_gx, v_gy;
  footprint_vjp(footprint, v.conic, options.antialiased ? v_opacity * gaussian.opacity : T(0), &v_m0, &v_m1);
  factor_vjp(g, gaussian.axes, v_m0, v_m1, &v_gx, &v_gy, &gradient->axes);
  const Vec3<T> v_p = pixel_gradients_vjp(camera, p, g, v_gx, v_gy, v.mean2d, v.depth, pose);
  camera_point_vjp(camera, gaussian.mean, v_p, &gradient->mean, pose);
}

// Adds the gradient of weight * min_j s_j (BlitzGS, L_scale). Of equal axes the first one gets it.
template <class T> BLITZGS_HD void smallest_axis_vjp(const Vec3<T>& scale, T weight, Vec3<T>* v_scale) {
  if (scale.x <= scale.y && scale.x <= scale.z) {
    v_scale->x += weight;
  } else if (scale.y <= scale.z) {
    v_scale->y += weight;
  } else {
    v_scale->z += weight;
  }
}

template <class T> struct ParameterGradients {
  T *mean, *quat, *scale, *opacity;
};

// Takes the gradients of the activated Gaussian back to the stored parameters (log scales and logit if raw)
// and writes them to `out`. axis_weight: the regularisers' weight of the smallest axis, over the splats.
template <class T>
BLITZGS_HD void activate_gaussian_vjp(const ActivatedGaussian<T>& gaussian, bool raw,
                                      const GaussianGradient<T>& gradient, T axis_weight,
                                      const ParameterGradients<T>& out) {
  store3(gradient.mean, out.mean);
  Vec3<T> v_scale;
  Columns3<T> v_rotation;
  scaled_axes_vjp(gaussian.rotation, gaussian.scale, gradient.axes, &v_scale, &v_rotation);
  smallest_axis_vjp(gaussian.scale, axis_weight, &v_scale);
  for (int i = 0; i < 4; ++i) out.quat[i] = T(0);
  rotation_columns_vjp(gaussian.quat, v_rotation, out.quat);
  const Vec3<T>& s = gaussian.scale;
  store3(raw ? Vec3<T>{s.x * v_scale.x, s.y * v_scale.y, s.z * v_scale.z} : v_scale, out.scale);
  *out.opacity = raw ? gradient.opacity * sigmoid_slope(gaussian.opacity) : gradient.opacity;
}

}  // namespace blitzgs
