// SPDX-License-Identifier: Apache-2.0
// Rotations from unnormalised quaternions (w, x, y, z), and the derivative.
#pragma once
#include "math/vec.h"

namespace blitzgs {

// The three columns of a 3x3 matrix: the images of the unit axes.
template <class T>
struct Columns3 {
  Vec3<T> x, y, z;
};

template <class T>
struct UnitQuaternion {
  T w, x, y, z;
  T inverse_norm;  // 1 / |q| of the quaternion it came from; 0 when that was zero
};

// A zero quaternion gives the identity, with a gradient of zero. The squares of very large or very small
// components leave the range of float, so such quaternions are first divided by their largest component.
template <class T>
BLITZGS_HD UnitQuaternion<T> normalize_quaternion(const T* q) {
  T scale = T(1);
  T squared = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
  if (!(squared > T(1e-24) && squared < T(1e24))) {
    const T top = larger(larger(std::fabs(q[0]), std::fabs(q[1])), larger(std::fabs(q[2]), std::fabs(q[3])));
    if (top == T(0) && squared == T(0)) return {T(1), T(0), T(0), T(0), T(0)};
    scale = top;
    const T w = q[0] / top, x = q[1] / top, y = q[2] / top, z = q[3] / top;
    squared = w * w + x * x + y * y + z * z;
    const T inverse = T(1) / std::sqrt(squared);
    return {w * inverse, x * inverse, y * inverse, z * inverse, inverse / scale};
  }
  const T inverse = T(1) / std::sqrt(squared);
  return {q[0] * inverse, q[1] * inverse, q[2] * inverse, q[3] * inverse, inverse};
}

template <class T>
BLITZGS_HD Columns3<T> rotation_columns(const UnitQuaternion<T>& q) {
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

}  // namespace blitzgs
