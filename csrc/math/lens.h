// SPDX-License-Identifier: Apache-2.0
// Lenses that distort and shutters that roll: the pixel of a point, and its derivative. The lenses, and which
// points are valid, are those of gsplat's main branch. All arithmetic is in double.
//
// A point with z <= 0 is invalid and at (0, 0). The others are at (fx u' + cx, fy v' + cy). With (u, v) =
// (x / z, y / z) and r2 = u^2 + v^2,
//   pinhole (OpenCV): s = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3),
//                     u' = u s + 2 p1 u v + p2 (r2 + 2 u^2) + s1 r2 + s2 r2^2,
//                     v' = v s + p1 (r2 + 2 v^2) + 2 p2 u v + s3 r2 + s4 r2^2, valid where s > 0.8
//   fisheye (OpenCV): (u', v') = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) (u, v) / |(u, v)| with t = atan
//                     |(u, v)|, valid where t is below the lens's largest angle; t is held there
// and a valid pixel also lies within `margin` image sizes of the image.
//
// A rolling shutter sees a pixel at the time that follows from its row or column, rounded, so that the time
// has no derivative. The time of a point is found in ten steps from its pixel at the begin of the frame, or
// at the end where only this one is valid.
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

template <class T>
BLITZGS_HD LensPose load_pose(const T* m) {
  return {{{m[0], m[4], m[8]}, {m[1], m[5], m[9]}, {m[2], m[6], m[10]}}, {m[3], m[7], m[11]}};
}

// The quaternion q [4] of a rotation, over the largest of its four numbers (Shepperd 1978).
BLITZGS_HD void quaternion_of(const Columns3<double>& r, double* q) {
  const double xx = r.x.x, yy = r.y.y, zz = r.z.z;
  const double wx = r.y.z - r.z.y, wy = r.z.x - r.x.z, wz = r.x.y - r.y.x;
  const double xy = r.x.y + r.y.x, xz = r.x.z + r.z.x, yz = r.y.z + r.z.y;
  const double rows[4][4] = {{1 + xx + yy + zz, wx, wy, wz},
                             {wx, 1 + xx - yy - zz, xy, xz},
                             {wy, xy, 1 - xx + yy - zz, yz},
                             {wz, xz, yz, 1 - xx - yy + zz}};
  int best = 0;
  for (int i = 1; i < 4; ++i) best = rows[i][i] > rows[best][best] ? i : best;
  const UnitQuaternion<double> unit = normalize_quaternion(rows[best]);
  q[0] = unit.w;
  q[1] = unit.x;
  q[2] = unit.y;
  q[3] = unit.z;
}

struct LensCamera {
  double fx, fy, cx, cy, width, height;
  double k[kLensNumbers];
  LensPose start, end;
  double q_start[4], q_end[4], angle;  // of a rolling shutter: rotations, and the angle between them

  // The pose at a time of the frame: translations interpolated linearly, rotations spherically.
  BLITZGS_HD LensPose at(const LensOptions& options, double time) const {
    if (options.shutter == Shutter::kGlobal) return start;
    const double sine = std::sin(angle), rest = 1 - time;
    const double a = sine > 1e-6 ? std::sin(rest * angle) / sine : rest;
    const double b = sine > 1e-6 ? std::sin(time * angle) / sine : time;
    double q[4];
    for (int i = 0; i < 4; ++i) q[i] = a * q_start[i] + b * q_end[i];
    return {rotation_columns(normalize_quaternion(q)), rest * start.translation + time * end.translation};
  }
};

// camera: makes a view that no pinhole projection has see nothing.
template <class T>
BLITZGS_HD LensCamera make_lens_camera(const Camera<T>& camera, int width, int height, const T* lens,
                                       const T* viewmat, const T* viewmat_rs) {
  LensCamera c{camera.fx, camera.fy, camera.cx, camera.cy, double(width), double(height)};
  for (int i = 0; i < kLensNumbers; ++i) c.k[i] = lens[i];
  c.start = load_pose(viewmat);
  if (!viewmat_rs) return c;
  c.end = load_pose(viewmat_rs);
  quaternion_of(c.start.columns, c.q_start);
  quaternion_of(c.end.columns, c.q_end);
  double cosine = 0;
  for (int i = 0; i < 4; ++i) cosine += c.q_start[i] * c.q_end[i];
  for (int i = 0; i < 4; ++i) c.q_end[i] = cosine < 0 ? -c.q_end[i] : c.q_end[i];
  c.angle = std::acos(smaller(std::fabs(cosine), 1.0));
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

BLITZGS_HD double shutter_time(const LensCamera& c, Shutter shutter, const LensPixel& pixel) {
  const double rows = larger(c.height - 1, 1.0), columns = larger(c.width - 1, 1.0);
  switch (shutter) {
    case Shutter::kTopToBottom:
      return std::floor(pixel.y) / rows;
    case Shutter::kLeftToRight:
      return std::floor(pixel.x) / columns;
    case Shutter::kBottomToTop:
      return (c.height - std::ceil(pixel.y)) / rows;
    case Shutter::kRightToLeft:
      return (c.width - std::ceil(pixel.x)) / columns;
    default:
      return 0;
  }
}

// The pixel of a world point, and the time at which the shutter sees it.
BLITZGS_HD LensPixel see_point(const LensCamera& c, const LensOptions& options, const Vec3<double>& point,
                               double* time) {
  constexpr int kSteps = 10;
  LensPixel pixel = lens_pixel(c, options, c.start.of(point));
  *time = 0;
  if (options.shutter == Shutter::kGlobal) return pixel;
  if (!pixel.valid) {
    pixel = lens_pixel(c, options, c.end.of(point));
    *time = 1;
    if (!pixel.valid) return pixel;
  }
  for (int i = 0; i < kSteps; ++i) {
    const double next = shutter_time(c, options.shutter, pixel);
    if (i > 0 && next == *time) break;
    *time = next;
    pixel = lens_pixel(c, options, c.at(options, next).of(point));
  }
  return pixel;
}

}  // namespace blitzgs
