// SPDX-License-Identifier: Apache-2.0
// A conservative test whether a view may see a Gaussian, from its mean and an upper bound sigma on its
// standard deviations, for blocks and rows of the table (active/blocks.h) and the projection's prefilter.
//
// A Gaussian with axes up to sigma cannot be seen iff its mean lies behind the near plane, beyond the far
// plane, or beyond one image border by more than a splat can reach: half-width of alpha >= 1/255 is at most
// sqrt(2 ln 255) sqrt(|J row|^2 sigma^2 + eps2d) pixels for an opacity of at most 1, with |J row| <= f / z
// max |row_x - u row_z| over the clamped slopes u. Multiplied by z, each condition is a linear inequality
// n . p + d + k sigma >= 0.
#pragma once
#include "math/projection.h"
#include "math/vec.h"

namespace blitzgs {

constexpr int kFrustumPlanes = 6, kDepthPlanes = 2;  // near and far, then two borders in x and two in y

// The largest relative rounding error of each term of the inequality of a point.
constexpr float kPointSlack = 4e-6f;

// The half-space n . p + d + k sigma >= 0. For single points, d_high is d plus its rounding error, and
// n_error |p|_1 bounds the rounding error of n . p.
struct alignas(16) FrustumPlane {
  float n[3], d_high, k, n_error, d;
};

struct Frustum {
  FrustumPlane planes[kFrustumPlanes];
};

struct PoseRow {
  double n[3], offset;
};

template <class T> BLITZGS_HD PoseRow pose_row(const Vec3<T>& row, T offset) {
  return {{double(row.x), double(row.y), double(row.z)}, double(offset)};
}

// The plane of the linear form factor * row + factor_z * row_z + shift, with the coefficient k of sigma.
BLITZGS_HD FrustumPlane make_plane(const PoseRow& row, double factor, const PoseRow& row_z, double factor_z,
                                   double shift, double k) {
  FrustumPlane plane;
  float largest = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    plane.n[axis] = float(factor * row.n[axis] + factor_z * row_z.n[axis]);
    largest = larger(largest, std::fabs(plane.n[axis]));
  }
  plane.d = float(factor * row.offset + factor_z * row_z.offset + shift);
  plane.d_high = plane.d + kPointSlack * std::fabs(plane.d);
  plane.k = float(k);
  plane.n_error = kPointSlack * largest;
  return plane;
}

// Largest |row - u row_z| over the slopes u in [low, high]. It is convex in u, so it is attained at an end.
BLITZGS_HD double largest_gradient(const PoseRow& row, const PoseRow& row_z, double low, double high) {
  double squares[2] = {0, 0};
  for (int axis = 0; axis < 3; ++axis) {
    const double a = row.n[axis] - low * row_z.n[axis], b = row.n[axis] - high * row_z.n[axis];
    squares[0] += a * a;
    squares[1] += b * b;
  }
  return std::sqrt(larger(squares[0], squares[1]));
}

template <class T>
BLITZGS_HD Frustum make_frustum(const Camera<T>& camera, int width, int height, T near_plane, T far_plane,
                                T eps2d) {
  constexpr double kReach = 3.34;  // > sqrt(2 ln 255)
  const PoseRow x = pose_row(camera.row_x, camera.translation.x),
                y = pose_row(camera.row_y, camera.translation.y),
                z = pose_row(camera.row_z, camera.translation.z);
  Frustum view;
  view.planes[0] = make_plane(z, 1.0, z, 0.0, -double(near_plane), 0.0);
  // A depth is rounded before it is compared with the far plane.
  view.planes[1] = make_plane(z, -1.0, z, 0.0, 1.000001 * double(far_plane), 0.0);
  const double blur = kReach * std::sqrt(double(eps2d)) + 1.0;  // one pixel of slack
  const auto add_borders = [&](FrustumPlane* planes, const PoseRow& row, double focal, double centre,
                               double size, double low, double high) {
    const double k = kReach * std::fabs(focal) * largest_gradient(row, z, low, high) * 1.00001;
    planes[0] = make_plane(row, focal, z, centre + blur, 0.0, k);
    planes[1] = make_plane(row, -focal, z, size - centre + blur, 0.0, k);
  };
  add_borders(view.planes + 2, x, camera.fx, camera.cx, width, camera.slope_min_x, camera.slope_max_x);
  add_borders(view.planes + 4, y, camera.fy, camera.cy, height, camera.slope_min_y, camera.slope_max_y);
  return view;
}

BLITZGS_HD float norm1(const Vec3<float>& v) { return std::fabs(v.x) + std::fabs(v.y) + std::fabs(v.z); }

// An upper bound on n . mean + d, rounding included. norm: norm1(mean).
BLITZGS_HD float upper_value(const FrustumPlane& plane, const Vec3<float>& mean, float norm) {
  const float value = mul_add(plane.n[1], mean.y, mul_add(plane.n[0], mean.x, plane.d_high));
  return mul_add(plane.n_error, norm, mul_add(plane.n[2], mean.z, value));
}

// Returns false only if project_splat would return false for a Gaussian of this mean with any shape.
BLITZGS_HD bool may_be_in_depth(const Frustum& view, const Vec3<float>& mean, float norm) {
  return upper_value(view.planes[0], mean, norm) >= 0.0f && upper_value(view.planes[1], mean, norm) >= 0.0f;
}

// Returns false only if project_splat would return false for every Gaussian of this mean with standard
// deviations of at most sigma. The caller has tested may_be_in_depth().
BLITZGS_HD bool may_overlap(const Frustum& view, const Vec3<float>& mean, float norm, float sigma) {
  bool overlaps = true;
  for (int i = kDepthPlanes; i < kFrustumPlanes; ++i) {
    const FrustumPlane& plane = view.planes[i];
    overlaps &= mul_add(plane.k, sigma, upper_value(plane, mean, norm)) >= 0.0f;
  }
  return overlaps;
}

// The sigma that callers give for an opacity above 1, because the planes assume an opacity of at most 1.
constexpr float kAnyWidth = 1e30f;

}  // namespace blitzgs
