// SPDX-License-Identifier: Apache-2.0
// The unscented projection (3DGUT, Wu et al. 2025; the transform of Wan and van der Merwe 2000): splats of
// Gaussians in views with a distorting lens or a rolling shutter (math/lens.h), and the derivative.
//
// With P(x) the pixel of a world point x, the mean mu and axes a_i of a Gaussian, n = alpha^2 (3 + kappa):
//   d_i = P(mu +- sqrt(n) a_i) - P(mu),   w = 1 / (2 n),   D = w sum d_i
//   mean2d = P(mu) + D,   Sigma' = w sum d_i d_i^T + (beta - alpha^2) D D^T + eps2d I
// These are the sums over seven weighted sigma points without their cancellation (the first has the weight 1
// - 3 / n = -99), in double, because the d_i are small differences of pixels. Depth is z at the pose in the
// middle of the frame, and colours are those from viewmats. A splat exists if one of its points, or each
// (all_valid), is valid, and by the rules of project.h.
//
// One thread for each pair of a Gaussian and a view finds which are splats, one for each splat computes it,
// and one for each Gaussian sums the gradients of its splats in order.
#pragma once
#include "math/lens.h"
#include "project/project.h"

namespace blitzgs {

inline constexpr int kSigmaPoints = 7;

struct UnscentedOptions : LensOptions {
  bool all_valid;
  double spread, weight, beyond;  // sqrt(n), w, beta - alpha^2
};

// Sigma point i: the mean, then the ends of the axes.
BLITZGS_HD Vec3<double> sigma_point(const ActivatedGaussian<double>& gaussian, double spread, int i) {
  const Columns3<double>& a = gaussian.axes;
  const double sign = i == 0 ? 0.0 : i <= 3 ? spread : -spread;
  return mul_add(sign, i % 3 == 1 ? a.x : i % 3 == 2 ? a.y : a.z, gaussian.mean);
}

struct UnscentedFootprint {
  double time[kSigmaPoints], offset[kSigmaPoints][2];  // of sigma points (see_point); d_i
  bool rolled[kSigmaPoints];
  double mean2d[2], shift[2];         // D
  double xx, xy, yy, unblurred, det;  // of Sigma', and the determinant before the blur
};

// Returns false if too few points are valid.
BLITZGS_HD bool unscented_footprint(const LensCamera& camera, const ActivatedGaussian<double>& gaussian,
                                    const UnscentedOptions& options, double eps2d, UnscentedFootprint* f) {
  double x = 0, y = 0, xx = 0, xy = 0, yy = 0;
  bool all = true, any = false;
  for (int i = 0; i < kSigmaPoints; ++i) {
    const SeenPoint seen = see_point(camera, options, sigma_point(gaussian, options.spread, i));
    const LensPixel& pixel = seen.pixel;
    f->time[i] = seen.time;
    f->rolled[i] = seen.rolled;
    all = all && pixel.valid;
    any = any || pixel.valid;
    if (i == 0) {
      f->mean2d[0] = pixel.x;
      f->mean2d[1] = pixel.y;
    }
    const double dx = f->offset[i][0] = pixel.x - f->mean2d[0];
    const double dy = f->offset[i][1] = pixel.y - f->mean2d[1];
    x += options.weight * dx;
    y += options.weight * dy;
    xx += options.weight * dx * dx;
    xy += options.weight * dx * dy;
    yy += options.weight * dy * dy;
  }
  f->shift[0] = x;
  f->shift[1] = y;
  f->mean2d[0] += x;
  f->mean2d[1] += y;
  xx += options.beyond * x * x;
  f->xy = xy + options.beyond * x * y;
  yy += options.beyond * y * y;
  f->unblurred = xx * yy - f->xy * f->xy;
  f->det = f->unblurred + eps2d * (xx + yy + eps2d);
  f->xx = xx + eps2d;
  f->yy = yy + eps2d;
  return options.all_valid ? all : any;
}

BLITZGS_HD double compensation(const UnscentedFootprint& f) {
  return f.unblurred > 0 ? std::sqrt(f.unblurred / f.det) : 0.0;
}

// Projects a Gaussian into a view. Returns false if the splat does not exist.
template <class T>
BLITZGS_HD bool unscented_splat(const LensCamera& camera, const ActivatedGaussian<double>& gaussian,
                                const ProjectOptions<T>& image, const UnscentedOptions& options,
                                Splat<T>* splat) {
  splat->depth = T(camera.at(0.5).of(gaussian.mean).z);
  if (!in_depth_range(splat->depth, image)) return false;
  const Vec3<double> axes = gaussian.axes.x + gaussian.axes.y + gaussian.axes.z;
  if (!is_finite(axes.x + axes.y + axes.z)) return false;
  UnscentedFootprint f;
  if (!unscented_footprint(camera, gaussian, options, image.eps2d, &f)) return false;
  if (!(f.det > 0 && f.xx >= 0 && f.yy >= 0)) return false;
  splat->mean2d[0] = T(f.mean2d[0]);
  splat->mean2d[1] = T(f.mean2d[1]);
  Footprint<T> rounded;
  rounded.cov_xx = T(f.xx);
  rounded.cov_yy = T(f.yy);
  if (!is_finite(rounded.cov_xx + rounded.cov_yy)) return false;
  rounded.magnitude = larger(rounded.cov_xx, rounded.cov_yy);
  rounded.root_det = T(std::sqrt(f.det) / rounded.magnitude);
  rounded.conic[0] = T(f.yy / f.det);
  rounded.conic[1] = T(-f.xy / f.det);
  rounded.conic[2] = T(f.xx / f.det);
  store_conic(rounded, splat->conic);
  splat->opacity = T(image.antialiased ? gaussian.opacity * compensation(f) : gaussian.opacity);
  return bound_splat(rounded, image, splat);
}

// Adds the gradients of one splat's geometry to `gradient`. Recomputes the sigma points.
template <class T>
BLITZGS_HD void unscented_splat_vjp(const LensCamera& camera, const ActivatedGaussian<double>& gaussian,
                                    const ProjectOptions<T>& image, const UnscentedOptions& options,
                                    const GeometryGradient<T>& v, GaussianGradient<double>* gradient) {
  UnscentedFootprint f;
  unscented_footprint(camera, gaussian, options, image.eps2d, &f);
  const double a = f.yy / f.det, b = -f.xy / f.det, c = f.xx / f.det;
  const double p = v.conic[0], q = 0.5 * v.conic[1], r = v.conic[2];
  // The gradient G = -Q V Q of Sigma', Q its inverse and V the gradient of Q, both symmetric.
  const double ap = a * p + b * q, aq = a * q + b * r, bp = b * p + c * q, bq = b * q + c * r;
  double g_xx = -(ap * a + aq * b), g_xy = -(ap * b + aq * c), g_yy = -(bp * b + bq * c);
  double v_opacity = v.opacity;
  if (image.antialiased) {
    const double factor = compensation(f), half = 0.5 * v_opacity * gaussian.opacity * factor;
    v_opacity *= factor;
    if (factor > 0) {  // the share of the determinant before the blur, then that of the one after it
      g_xx += half * ((f.yy - image.eps2d) / f.unblurred - a);
      g_xy += half * (-f.xy / f.unblurred - b);
      g_yy += half * ((f.xx - image.eps2d) / f.unblurred - c);
    }
  }
  gradient->opacity += v_opacity;
  const auto times_g = [&](double x, double y, double factor, double* out) {
    out[0] += factor * (g_xx * x + g_xy * y);
    out[1] += factor * (g_xy * x + g_yy * y);
  };
  double v_shift[2] = {v.mean2d[0], v.mean2d[1]}, v_first[2] = {v.mean2d[0], v.mean2d[1]};
  times_g(f.shift[0], f.shift[1], 2 * options.beyond, v_shift);
  // Backwards: the first point's gradient is what those of the others leave.
  for (int i = kSigmaPoints - 1; i >= 0; --i) {
    double v_offset[2] = {options.weight * v_shift[0], options.weight * v_shift[1]};
    times_g(f.offset[i][0], f.offset[i][1], 2 * options.weight, v_offset);
    if (i > 0) {
      v_first[0] -= v_offset[0];
      v_first[1] -= v_offset[1];
    }
    const double* v_pixel = i > 0 ? v_offset : v_first;
    const Vec3<double> v_point = see_point_vjp(camera, options, sigma_point(gaussian, options.spread, i),
                                               f.time[i], f.rolled[i], v_pixel);
    gradient->mean = gradient->mean + v_point;
    if (i == 0) continue;
    Vec3<double>& v_axis = i % 3 == 1 ? gradient->axes.x : i % 3 == 2 ? gradient->axes.y : gradient->axes.z;
    v_axis = mul_add(i <= 3 ? options.spread : -options.spread, v_point, v_axis);
  }
  const Vec3<double> along{0, 0, double(v.depth)};
  gradient->mean = gradient->mean + camera.at(0.5).world_vjp(along);
}

// What the three passes below read. lenses [B, kLensNumbers]; viewmats_rs [B, 4, 4], the poses at the end of
// the frame, null for a global shutter.
template <class T> struct UnscentedInputs {
  ProjectInputs<T> in;
  const T *lenses, *viewmats_rs;
  UnscentedOptions options;

  BLITZGS_HD LensCamera camera(int view) const {
    return make_lens_camera(in.camera(view), in.options.width, in.options.height,
                            lenses + kLensNumbers * view, options.shutter, in.viewmats + 16 * view,
                            viewmats_rs ? viewmats_rs + 16 * view : nullptr);
  }
  BLITZGS_HD ActivatedGaussian<double> gaussian(int64_t id) const {
    const T *m = in.means + 3 * id, *q = in.quats + 4 * id, *s = in.scales + 3 * id;
    const double quat[4] = {q[0], q[1], q[2], q[3]}, scale[3] = {s[0], s[1], s[2]};
    return activate_gaussian(Vec3<double>{m[0], m[1], m[2]}, quat, activate_scale(scale, in.options.raw),
                             activate_opacity(double(in.opacities[id]), in.options.raw));
  }
};

// Row i: whether Gaussian i / B has a splat in view i % B; seen [N, B].
template <class T> struct UnscentedVisible {
  UnscentedInputs<T> inputs;
  bool* seen;
  int64_t n;

  BLITZGS_HD void operator()(int64_t i) const {
    const int view = int(i % inputs.in.n_views);
    Splat<T> splat;
    seen[i] = unscented_splat(inputs.camera(view), inputs.gaussian(i / inputs.in.n_views), inputs.in.options,
                              inputs.options, &splat);
  }
};

// Row i: the values of splat i, of Gaussian gaussian_ids[i] in view camera_ids[i].
template <class T> struct UnscentedSplats {
  UnscentedInputs<T> inputs;
  const int32_t *gaussian_ids, *camera_ids;
  ProjectOutputs<T> out;
  int64_t n;

  BLITZGS_HD void operator()(int64_t i) const {
    const ProjectInputs<T>& in = inputs.in;
    const int64_t id = gaussian_ids[i];
    const int view = camera_ids[i];
    Splat<T> splat{};
    bool shown =
        unscented_splat(inputs.camera(view), inputs.gaussian(id), in.options, inputs.options, &splat);
    if (in.sh) {
      shown = splat_color(in.camera(view), load3(in.means + 3 * id), in.sh + 3 * in.options.sh_stride * id,
                          in.options.sh_degree, out.colors + 3 * i) &&
              shown;
    }
    int64_t ranks;
    const int32_t tiles = splat_tiles(splat, 0, in.options, RankTiles{}, &ranks, [](int, int64_t) {});
    for (int k = 0; k < 2; ++k) {
      out.means2d[2 * i + k] = splat.mean2d[k];
      out.radii[2 * i + k] = shown ? pixel_radius(splat.extent[k]) : 0;
    }
    for (int k = 0; k < 3; ++k) out.conics[3 * i + k] = splat.conic[k];
    out.depths[i] = splat.depth;
    out.opacities[i] = shown ? splat.opacity : T(0);
    out.tiles_touched[i] = shown ? tiles : 0;
  }
};

// Row i: the gradients of Gaussian i of N, whose splats are offsets[i] to offsets[i + 1] - 1; zeros if it has
// none. offsets [N + 1]. The outputs have a row for each Gaussian; viewmats get none.
template <class T> struct UnscentedGradients {
  UnscentedInputs<T> inputs;
  const int32_t *camera_ids, *offsets;
  SplatGradientColumns<T> v;
  ProjectGradients<T> out;
  int64_t n;

  BLITZGS_HD void operator()(int64_t i) const {
    const ProjectInputs<T>& in = inputs.in;
    const int64_t stride = 3 * in.options.sh_stride;
    for (int64_t k = 0; in.sh && k < stride; ++k) out.sh[stride * i + k] = T(0);
    double mean[3] = {}, quat[4] = {}, scale[3] = {}, opacity = 0;
    if (offsets[i] < offsets[i + 1]) {
      const ActivatedGaussian<double> gaussian = inputs.gaussian(i);
      GaussianGradient<double> gradient{};
      Vec3<T> v_mean{};
      for (int64_t r = offsets[i]; r < offsets[i + 1]; ++r) {
        const int view = camera_ids[r];
        unscented_splat_vjp(inputs.camera(view), gaussian, in.options, inputs.options, v.geometry(r),
                            &gradient);
        if (!in.sh) continue;
        splat_color_vjp(in.camera(view), load3(in.means + 3 * i), in.sh + stride * i, in.options.sh_degree,
                        v.colors + 3 * r, out.sh + stride * i, &v_mean,
                        static_cast<PoseGradient<T>*>(nullptr));
      }
      gradient.mean = gradient.mean + Vec3<double>{v_mean.x, v_mean.y, v_mean.z};
      activate_gaussian_vjp(gaussian, in.options.raw, gradient, 0.0,
                            ParameterGradients<double>{mean, quat, scale, &opacity});
    }
    for (int k = 0; k < 3; ++k) {
      out.means[3 * i + k] = T(mean[k]);
      out.scales[3 * i + k] = T(scale[k]);
    }
    for (int k = 0; k < 4; ++k) out.quats[4 * i + k] = T(quat[k]);
    out.opacities[i] = T(opacity);
  }
};

}  // namespace blitzgs
