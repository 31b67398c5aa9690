// SPDX-License-Identifier: Apache-2.0
// Lenses that distort and shutters that roll: the pixel of a point, and its derivative. The lenses, and which
// points are valid, are those of gsplat's main branch. All arithmetic is in double.
//
// A point with z <= 0 is invalid and at (0, 0). The others are at (fx u' + cx, fy v' + cy). With
// (u, v) = (x / z, y / z) and r2 = u^2 + v^2,
//   pinhole (OpenCV): s = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3),
//                     u' = u s + 2 p1 u v + p2 (r2 + 2 u^2) + s1 r2 + s2 r2^2,
//                     v' = v s + p1 (r2 + 2 v^2) + 2 p2 u v + s3 r2 + s4 r2^2, valid where s > 0.8
//   fisheye (OpenCV): (u', v') = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) (u, v) / |(u, v)| with
//                     t = atan |(u, v)|, valid where t is below the lens's largest angle; t is held there
// and a valid pixel also lies within `margin` image sizes of the image.
//
// A rolling shutter sees the first row (or column) at the time 0 and the last one at 1. The time of a point
// is found in at most 20 steps from its pixel at the begin of the frame, or at the end where only this one is
// valid. Unlike gsplat's it is not rounded to that of a row, which close pixels would show.
#pragma once
#include "math/projection.h"

namespace blitzgs {

inline constexpr int kLensNumbers = 13;  // k1 to k6, p1, p2, s1 to s4, the largest angle of a fisheye
enum class Shutter : int { kTopToBottom, kLeftToRight, kBottomToTop, kRightToLeft, kGlobal };

struct LensOptions {
  bool fisheye;
  Shutter shutter;
  double margin;
};

// World to camera: the columns of the rotation.
struct LensPose {
  Columns3<double> columns;
  Vec3<double> translation;

  BLITZGS_HD Vec3<double> of(const Vec3<double>& point) const {
    return point.x * columns.x + point.y * columns.y + point.z * columns.z + translation;
  }
  BLITZGS_HD Vec3<double> world_vjp(const Vec3<double>& v) const {
    return {dot(columns.x, v), dot(columns.y, v), dot(columns.z, v)};
  }
};

template <class T> BLITZGS_HD LensPose load_pose(const T* m) {
  return {{{m[0], m[4], m[8]}, {m[1], m[5], m[9]}, {m[2], m[6], m[10]}}, {m[3], m[7], m[11]}};
}

// The rotation vector of a rotation: its axis, as long as its angle (by the quaternion of Shepperd 1978).
BLITZGS_HD Vec3<double> rotation_vector(const Columns3<double>& r) {
  const double xx = r.x.x, yy = r.y.y, zz = r.z.z;
  const double wx = r.y.z - r.z.y, wy = r.z.x - r.x.z, wz = r.x.y - r.y.x;
  const double xy = r.x.y + r.y.x, xz = r.x.z + r.z.x, yz = r.y.z + r.z.y;
  const double rows[4][4] = {{1 + xx + yy + zz, wx, wy, wz},
                             {wx, 1 + xx - yy - zz, xy, xz},
                             {wy, xy, 1 - xx + yy - zz, yz},
                             {wz, xz, yz, 1 - xx - yy + zz}};
  int best = 0;
  for (int i = 1; i < 4; ++i) best = rows[i][i] > rows[best][best] ? i : best;
  const double* q = rows[best];
  const double sign = q[0] < 0 ? -1.0 : 1.0;
  const Vec3<double> axis{sign * q[1], sign * q[2], sign * q[3]};
  const double length = std::sqrt(dot(axis, axis));
  return length > 0 ? 2 * std::atan2(length, sign * q[0]) / length * axis : Vec3<double>{0, 0, 0};
}

struct LensCamera {
  double fx, fy, cx, cy, width, height;
  double k[kLensNumbers];
  LensPose start, end;
  Vec3<double> turn, shift;  // of the pose from the begin of the frame to its end: a rotation vector, and t
  double row_time[2];        // derivative of the time at which the shutter sees a pixel by the pixel

  // The pose at a time of the frame: it turns and moves at constant rates.
  BLITZGS_HD LensPose at(double time) const {
    const double angle = std::sqrt(dot(turn, turn));
    if (angle == 0) return {start.columns, start.translation + time * shift};
    const double half = 0.5 * time * angle, sine = std::sin(half) / angle;
    const Columns3<double> r = rotation_columns(
        UnitQuaternion<double>{std::cos(half), sine * turn.x, sine * turn.y, sine * turn.z, 1});
    const auto turned = [&](const Vec3<double>& v) { return v.x * r.x + v.y * r.y + v.z * r.z; };
    return {{turned(start.columns.x), turned(start.columns.y), turned(start.columns.z)},
            start.translation + time * shift};
  }
  BLITZGS_HD double time_of(double x, double y) const {
    const double time = row_time[0] * (x - 0.5) + row_time[1] * (y - 0.5);
    return row_time[0] + row_time[1] < 0 ? 1 + time : time;
  }
};

// camera: makes a view that no pinhole projection has see nothing. viewmat_rs: null for a global shutter.
template <class T>
BLITZGS_HD LensCamera make_lens_camera(const Camera<T>& camera, int width, int height, const T* lens,
                                       Shutter shutter, const T* viewmat, const T* viewmat_rs) {
  LensCamera c{};
  c.fx = camera.fx;
  c.fy = camera.fy;
  c.cx = camera.cx;
  c.cy = camera.cy;
  c.width = width;
  c.height = height;
  for (int i = 0; i < kLensNumbers; ++i) c.k[i] = lens[i];
  c.start = c.end = load_pose(viewmat);
  if (!viewmat_rs) return c;
  c.end = load_pose(viewmat_rs);
  const Columns3<double>& s = c.start.columns;
  const Vec3<double> origin{0, 0, 0};
  const LensPose rotation{c.end.columns, origin};
  c.turn = rotation_vector({rotation.of({s.x.x, s.y.x, s.z.x}), rotation.of({s.x.y, s.y.y, s.z.y}),
                            rotation.of({s.x.z, s.y.z, s.z.z})});
  c.shift = c.end.translation - c.start.translation;
  const bool rows = shutter == Shutter::kTopToBottom || shutter == Shutter::kBottomToTop;
  const bool forward = shutter == Shutter::kTopToBottom || shutter == Shutter::kLeftToRight;
  c.row_time[rows ? 1 : 0] = (forward ? 1.0 : -1.0) / larger((rows ? c.height : c.width) - 1, 1.0);
  return c;
}

struct LensPixel {
  double x, y;
  bool valid;
};

// (u', v') of a point and its derivative, in parts.
struct Brown {
  double u, v, r2, scale, slope;  // s, and its derivative by r2

  BLITZGS_HD Brown(const double* k, const Vec3<double>& q) : u(q.x / q.z), v(q.y / q.z), r2(u * u + v * v) {
    const double above = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
    const double below = 1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
    const bool exists = std::fabs(below) > 1e-8;
    scale = exists ? above / below : 0.0;
    const double above_slope = k[0] + r2 * (2 * k[1] + r2 * 3 * k[2]);
    const double below_slope = k[3] + r2 * (2 * k[4] + r2 * 3 * k[5]);
    slope = exists ? (above_slope - scale * below_slope) / below : 0.0;
  }
  BLITZGS_HD double across(const double* k) const {
    return u * scale + 2 * k[6] * u * v + k[7] * (r2 + 2 * u * u) + r2 * (k[8] + r2 * k[9]);
  }
  BLITZGS_HD double down(const double* k) const {
    return v * scale + k[6] * (r2 + 2 * v * v) + 2 * k[7] * u * v + r2 * (k[10] + r2 * k[11]);
  }
  // a, b: the gradients of u' and v'.
  BLITZGS_HD Vec3<double> vjp(const double* k, double z, double a, double b) const {
    const double v_r2 =
        (a * u + b * v) * slope + a * (k[7] + k[8] + 2 * k[9] * r2) + b * (k[6] + k[10] + 2 * k[11] * r2);
    const double v_u = a * (scale + 2 * k[6] * v + 4 * k[7] * u) + 2 * b * k[7] * v + 2 * u * v_r2;
    const double v_v = b * (scale + 4 * k[6] * v + 2 * k[7] * u) + 2 * a * k[6] * u + 2 * v * v_r2;
    return {v_u / z, v_v / z, -(v_u * u + v_v * v) / z};
  }
};

// (u', v') = stretch (x, y) of a fisheye; the derivatives of the stretch by the distance from the axis, over
// this distance, and by z.
struct Fisheye {
  double angle, stretch, by_radius, by_z;

  BLITZGS_HD Fisheye(const double* k, const Vec3<double>& q) {
    const double radius = std::sqrt(q.x * q.x + q.y * q.y), most = k[kLensNumbers - 1];
    angle = std::atan2(radius, q.z);
    if (radius <= 1e-9 * q.z) {  // the limit on the axis
      stretch = 1 / q.z;
      by_radius = 0;
      by_z = -stretch * stretch;
      return;
    }
    const double t = smaller(angle, most), t2 = t * t;
    const double value = t * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    const double rise = 1 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])));
    const double slope = angle < most ? rise / (radius * radius + q.z * q.z) : 0.0;
    stretch = value / radius;
    by_radius = (slope * q.z - stretch) / (radius * radius);
    by_z = -slope;
  }
};

BLITZGS_HD LensPixel lens_pixel(const LensCamera& c, const LensOptions& options, const Vec3<double>& q) {
  if (!(q.z > 0)) return {0, 0, false};
  LensPixel pixel;
  if (options.fisheye) {
    const Fisheye lens(c.k, q);
    if (!(lens.stretch > 0)) return {0, 0, false};
    pixel = {c.fx * lens.stretch * q.x + c.cx, c.fy * lens.stretch * q.y + c.cy,
             lens.angle < c.k[kLensNumbers - 1]};
  } else {
    const Brown lens(c.k, q);
    pixel = {c.fx * lens.across(c.k) + c.cx, c.fy * lens.down(c.k) + c.cy, lens.scale > 0.8};
  }
  const double beside = options.margin * c.width, above = options.margin * c.height;
  pixel.valid = pixel.valid && -beside <= pixel.x && pixel.x < c.width + beside && -above <= pixel.y &&
                pixel.y < c.height + above;
  return pixel;
}

// The gradient of the camera-space point q from that of its pixel.
BLITZGS_HD Vec3<double> lens_pixel_vjp(const LensCamera& c, const LensOptions& options, const Vec3<double>& q,
                                       double v_x, double v_y) {
  if (!(q.z > 0)) return {0, 0, 0};
  const double a = c.fx * v_x, b = c.fy * v_y;
  if (!options.fisheye) return Brown(c.k, q).vjp(c.k, q.z, a, b);
  const Fisheye lens(c.k, q);
  if (!(lens.stretch > 0)) return {0, 0, 0};
  const double v_stretch = a * q.x + b * q.y, along = v_stretch * lens.by_radius;
  return {a * lens.stretch + along * q.x, b * lens.stretch + along * q.y, v_stretch * lens.by_z};
}

// A pixel of a world point: the time at which the shutter sees it, and whether this depends on the pixel.
struct SeenPoint {
  LensPixel pixel;
  double time;
  bool rolled;
};

BLITZGS_HD SeenPoint see_point(const LensCamera& c, const LensOptions& options, const Vec3<double>& point) {
  constexpr int kSteps = 20;
  SeenPoint seen{lens_pixel(c, options, c.start.of(point)), 0, false};
  if (options.shutter == Shutter::kGlobal) return seen;
  if (!seen.pixel.valid) {
    seen = {lens_pixel(c, options, c.end.of(point)), 1, false};
    if (!seen.pixel.valid) return seen;
  }
  for (int i = 0; i < kSteps; ++i) {
    const double time = c.time_of(seen.pixel.x, seen.pixel.y);
    if (seen.rolled && time == seen.time) break;
    seen = {lens_pixel(c, options, c.at(time).of(point)), time, true};
  }
  return seen;
}

// The gradient of a world point from that of its pixel p. The time follows the pixel: dp = J dx + u dt with
// the pixel's velocity u, and dt = row_time . dp.
BLITZGS_HD Vec3<double> see_point_vjp(const LensCamera& c, const LensOptions& options,
                                      const Vec3<double>& point, double time, bool rolled,
                                      const double* v_pixel) {
  const LensPose pose = c.at(time);
  const Vec3<double> q = pose.of(point);
  if (!rolled) return pose.world_vjp(lens_pixel_vjp(c, options, q, v_pixel[0], v_pixel[1]));
  const Vec3<double> across = lens_pixel_vjp(c, options, q, 1, 0), down = lens_pixel_vjp(c, options, q, 0, 1);
  const Vec3<double> velocity = cross(c.turn, q - pose.translation) + c.shift;
  const double u[2] = {dot(across, velocity), dot(down, velocity)};
  const double v_time =
      (u[0] * v_pixel[0] + u[1] * v_pixel[1]) / (1 - c.row_time[0] * u[0] - c.row_time[1] * u[1]);
  return pose.world_vjp((v_pixel[0] + v_time * c.row_time[0]) * across +
                        (v_pixel[1] + v_time * c.row_time[1]) * down);
}

}  // namespace blitzgs
