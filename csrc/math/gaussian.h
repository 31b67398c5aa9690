// SPDX-License-Identifier: Apache-2.0
// A Gaussian's rotation, axes and activations, and the spherical harmonics of its colour, with their
// derivatives (docs/image.md, sections 1 and 4).
#pragma once
#include <limits>

#include "math/vec.h"

namespace blitzgs {

// The three columns of a 3x3 matrix: the images of the unit axes.
template <class T> struct Columns3 {
  Vec3<T> x, y, z;
};

template <class T> struct UnitQuaternion {
  T w, x, y, z;
  T inverse_norm;  // 1 / |q| of the quaternion it came from; 0 when that was zero
};

// A quaternion of zeros, or one so short that its inverse norm would overflow, gives the identity and a
// gradient of zero. The squares of very large or small components leave the range of float, so such
// quaternions are first divided by their largest component.
template <class T> BLITZGS_HD UnitQuaternion<T> normalize_quaternion(const T* q) {
  T scale = T(1);
  T squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  if (!(squared > T(1e-24) && squared < T(1e24))) {
    const T top = larger(larger(std::fabs(q[0]), std::fabs(q[1])), larger(std::fabs(q[2]), std::fabs(q[3])));
    // `squared` is NaN if a component is, and then so is the result.
    if (top < T(1) / std::numeric_limits<T>::max() && squared >= T(0)) return {T(1), T(0), T(0), T(0), T(0)};
    scale = top;
    const T w = q[0] / top, x = q[1] / top, y = q[2] / top, z = q[3] / top;
    squared = w * w + x * x + y * y + z * z;
    const T inverse = T(1) / std::sqrt(squared);
    return {w * inverse, x * inverse, y * inverse, z * inverse, inverse / scale};
  }
  const T inverse = T(1) / std::sqrt(squared);
  return {q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse, inverse};
}

template <class T> BLITZGS_HD Columns3<T> rotation_columns(const UnitQuaternion<T>& q) {
  const T w = q.w, x = q.x, y = q.y, z = q.z;
  return {{T(1) - T(2) * (y * y + z * z), T(2) * (x * y + w * z), T(2) * (x * z - w * y)},
          {T(2) * (x * y - w * z), T(1) - T(2) * (x * x + z * z), T(2) * (y * z + w * x)},
          {T(2) * (x * z + w * y), T(2) * (y * z - w * x), T(1) - T(2) * (x * x + y * y)}};
}

// v_q += the gradient of the unnormalised quaternion, from the gradient v of the rotation's columns.
template <class T>
BLITZGS_HD void rotation_columns_vjp(const UnitQuaternion<T>& q, const Columns3<T>& v, T* v_q) {
  const T w = q.w, x = q.x, y = q.y, z = q.z;
  const T v_w = T(2) * (x * (v.y.z - v.z.y) + y * (v.z.x - v.x.z) + z * (v.x.y - v.y.x));
  const T v_x =
      T(2) * (w * (v.y.z - v.z.y) + y * (v.x.y + v.y.x) + z * (v.x.z + v.z.x)) - T(4) * x * (v.y.y + v.z.z);
  const T v_y =
      T(2) * (w * (v.z.x - v.x.z) + x * (v.x.y + v.y.x) + z * (v.y.z + v.z.y)) - T(4) * y * (v.x.x + v.z.z);
  const T v_z =
      T(2) * (w * (v.x.y - v.y.x) + x * (v.x.z + v.z.x) + y * (v.y.z + v.z.y)) - T(4) * z * (v.x.x + v.y.y);
  // A change of q along itself does not change the unit quaternion, so that part of the gradient is removed.
  const T along = w * v_w + x * v_x + y * v_y + z * v_z;
  v_q[0] += q.inverse_norm * (v_w - along * w);
  v_q[1] += q.inverse_norm * (v_x - along * x);
  v_q[2] += q.inverse_norm * (v_y - along * y);
  v_q[3] += q.inverse_norm * (v_z - along * z);
}

// Activations, and the 3D covariance (Kerbl et al. 2023, Eq. 6) in factored form: Sigma = A A^T with A = R(q)
// diag(s). The projection is more accurate from A (projection.h).

template <class T> BLITZGS_HD T sigmoid(T logit) { return T(1) / (T(1) + std::exp(-logit)); }

// d sigmoid / d logit from the value o of the sigmoid.
template <class T> BLITZGS_HD T sigmoid_slope(T o) { return o * (T(1) - o); }

// A = R diag(s): the Gaussian's axes, one column each.
template <class T> BLITZGS_HD Columns3<T> scaled_axes(const Columns3<T>& rotation, const Vec3<T>& scale) {
  return {scale.x * rotation.x, scale.y * rotation.y, scale.z * rotation.z};
}

// Sets v_scale and v_rotation to the gradients that follow from v_axes.
template <class T>
BLITZGS_HD void scaled_axes_vjp(const Columns3<T>& rotation, const Vec3<T>& scale, const Columns3<T>& v_axes,
                                Vec3<T>* v_scale, Columns3<T>* v_rotation) {
  *v_scale = {dot(rotation.x, v_axes.x), dot(rotation.y, v_axes.y), dot(rotation.z, v_axes.z)};
  *v_rotation = scaled_axes(v_axes, scale);
}

// Real spherical harmonics of degree 0 to 3 in the order and with the signs of 3D Gaussian Splatting: basis
// values at a unit direction, and the derivative with respect to that direction.

inline constexpr int kMaxShDegree = 3;
inline constexpr int kMaxShBasis = 16;

BLITZGS_HD int sh_basis_count(int degree) { return (degree + 1) * (degree + 1); }

// basis[0 .. (degree + 1)^2) at the unit direction d.
template <class T> BLITZGS_HD void sh_basis(int degree, const Vec3<T>& d, T* basis) {
  basis[0] = T(0.28209479177387814);
  if (degree < 1) return;
  const T x = d.x, y = d.y, z = d.z;
  basis[1] = T(-0.48860251190291992) * y;
  basis[2] = T(0.48860251190291992) * z;
  basis[3] = T(-0.48860251190291992) * x;
  if (degree < 2) return;
  const T xx = x * x, yy = y * y, zz = z * z;
  basis[4] = T(1.0925484305920792) * x * y;
  basis[5] = T(-1.0925484305920792) * y * z;
  basis[6] = T(0.31539156525252005) * (T(2) * zz - xx - yy);
  basis[7] = T(-1.0925484305920792) * x * z;
  basis[8] = T(0.54627421529603959) * (xx - yy);
  if (degree < 3) return;
  basis[9] = T(-0.59004358992664352) * y * (T(3) * xx - yy);
  basis[10] = T(2.8906114426405538) * x * y * z;
  basis[11] = T(-0.45704579946446572) * y * (T(4) * zz - xx - yy);
  basis[12] = T(0.37317633259011546) * z * (T(2) * zz - T(3) * xx - T(3) * yy);
  basis[13] = T(-0.45704579946446572) * x * (T(4) * zz - xx - yy);
  basis[14] = T(1.4453057213202769) * z * (xx - yy);
  basis[15] = T(-0.59004358992664352) * x * (xx - T(3) * yy);
}

// Gradient of sum_k v_basis[k] * basis[k] with respect to the direction.
template <class T> BLITZGS_HD Vec3<T> sh_basis_vjp(int degree, const Vec3<T>& d, const T* v) {
  Vec3<T> g{T(0), T(0), T(0)};
  if (degree < 1) return g;
  const T x = d.x, y = d.y, z = d.z;
  g = T(0.48860251190291992) * Vec3<T>{-v[3], -v[1], v[2]};
  if (degree < 2) return g;
  const T a = T(1.0925484305920792), b = T(0.31539156525252005);
  g.x += a * (y * v[4] - z * v[7] + x * v[8]) - T(2) * b * x * v[6];
  g.y += a * (x * v[4] - z * v[5] - y * v[8]) - T(2) * b * y * v[6];
  g.z += T(4) * b * z * v[6] - a * (y * v[5] + x * v[7]);
  if (degree < 3) return g;
  const T c = T(0.59004358992664352), e = T(2.8906114426405538), f = T(0.45704579946446572);
  const T h = T(0.37317633259011546), k = T(1.4453057213202769);
  const T xx = x * x, yy = y * y, zz = z * z;
  g.x += -T(6) * c * x * y * v[9] + e * y * z * v[10] + T(2) * f * x * y * v[11] - T(6) * h * x * z * v[12] -
         f * (T(4) * zz - T(3) * xx - yy) * v[13] + T(2) * k * x * z * v[14] - T(3) * c * (xx - yy) * v[15];
  g.y += -T(3) * c * (xx - yy) * v[9] + e * x * z * v[10] - f * (T(4) * zz - xx - T(3) * yy) * v[11] -
         T(6) * h * y * z * v[12] + T(2) * f * x * y * v[13] - T(2) * k * y * z * v[14] +
         T(6) * c * x * y * v[15];
  g.z += e * x * y * v[10] - T(8) * f * y * z * v[11] + T(3) * h * (T(2) * zz - xx - yy) * v[12] -
         T(8) * f * x * z * v[13] + k * (xx - yy) * v[14];
  return g;
}

}  // namespace blitzgs
