// SPDX-License-Identifier: Apache-2.0
// Activations, and the 3D covariance in factored form: Sigma = A A^T with A = R(q) diag(s). The factor is
// kept instead of the product, because everything downstream is more accurate from it.
#pragma once
#include "math/quaternion.h"

namespace blitzgs {

template <class T>
BLITZGS_HD T sigmoid(T logit) {
  return T(1) / (T(1) + std::exp(-logit));
}

// d sigmoid / d logit from the value o of the sigmoid.
template <class T>
BLITZGS_HD T sigmoid_slope(T o) {
  return o * (T(1) - o);
}

// A = R diag(s): the Gaussian's axes, one column each.
template <class T>
BLITZGS_HD Columns3<T> scaled_axes(const Columns3<T>& rotation, const Vec3<T>& scale) {
  return {scale.x * rotation.x, scale.y * rotation.y, scale.z * rotation.z};
}

// v_scale and v_rotation are overwritten with the gradients that follow from v_axes.
template <class T>
BLITZGS_HD void scaled_axes_vjp(const Columns3<T>& rotation, const Vec3<T>& scale, const Columns3<T>& v_axes,
                                Vec3<T>* v_scale, Columns3<T>* v_rotation) {
  *v_scale = {dot(rotation.x, v_axes.x), dot(rotation.y, v_axes.y), dot(rotation.z, v_axes.z)};
  *v_rotation = scaled_axes(v_axes, scale);
}

}  // namespace blitzgs
