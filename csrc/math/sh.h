// SPDX-License-Identifier: Apache-2.0
// Real spherical harmonics of degree 0 to 3 in the order and with the signs of 3D Gaussian Splatting: basis
// values at a unit direction, and the derivative with respect to that direction.
#pragma once
#include "math/vec.h"

namespace blitzgs {

inline constexpr int kMaxShDegree = 3;
inline constexpr int kMaxShBasis = 16;

BLITZGS_HD int sh_basis_count(int degree) { return (degree + 1) * (degree + 1); }

// basis[0 .. (degree + 1)^2) at the unit direction d.
template <class T>
BLITZGS_HD void sh_basis(int degree, const Vec3<T>& d, T* basis) {
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
template <class T>
BLITZGS_HD Vec3<T> sh_basis_vjp(int degree, const Vec3<T>& d, const T* v) {
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
