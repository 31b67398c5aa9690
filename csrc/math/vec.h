// SPDX-License-Identifier: Apache-2.0
// Three-vectors and the few scalar helpers the maths headers share.
#pragma once
#include <cmath>
#include <cstring>
#include <type_traits>

#include "common/kernel.h"

namespace blitzgs {

// a b + c. On a GPU this is a fused multiply-add. On a CPU the compiler must not contract products (the build
// says so), and fma() would be a library call.
template <class T> BLITZGS_HD T mul_add(T a, T b, T c) {
#ifdef __CUDA_ARCH__
  return fma(a, b, c);
#else
  return a * b + c;
#endif
}

// A product that will be added to something: the compiler may not fuse it with that addition.
template <class T> BLITZGS_HD T mul(T a, T b) {
#ifdef __CUDA_ARCH__
  if constexpr (sizeof(T) == 4) {
    return __fmul_rn(a, b);
  } else {
    return __dmul_rn(a, b);
  }
#else
  return a * b;
#endif
}

// The reciprocal of a number that is zero or normal; on a GPU its error is at most 1 ulp.
template <class T> BLITZGS_HD T reciprocal(T x) {
#ifdef __CUDA_ARCH__
  if constexpr (sizeof(T) == 4) {
    asm("rcp.approx.ftz.f32 %0, %0;" : "+f"(x));
    return x;
  }
#endif
  return T(1) / x;
}

// Maps floats to unsigned integers of the same order; -0 comes before 0.
template <class T> BLITZGS_HD auto ordered_bits(T value) {
  using Bits = std::conditional_t<sizeof(T) == 4, uint32_t, uint64_t>;
  constexpr int kSign = 8 * sizeof(T) - 1;
  Bits bits;
  std::memcpy(&bits, &value, sizeof(bits));
  return bits ^ (bits >> kSign ? ~Bits{0} : Bits{1} << kSign);
}

template <class T> struct Vec3 {
  T x, y, z;
};

template <class T> BLITZGS_HD Vec3<T> operator+(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class T> BLITZGS_HD Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class T> BLITZGS_HD Vec3<T> operator*(T s, const Vec3<T>& a) { return {s * a.x, s * a.y, s * a.z}; }
template <class T> BLITZGS_HD T dot(const Vec3<T>& a, const Vec3<T>& b) {
  return mul_add(a.z, b.z, mul_add(a.y, b.y, a.x * b.x));
}
// s a + b.
template <class T> BLITZGS_HD Vec3<T> mul_add(T s, const Vec3<T>& a, const Vec3<T>& b) {
  return {mul_add(s, a.x, b.x), mul_add(s, a.y, b.y), mul_add(s, a.z, b.z)};
}
template <class T> BLITZGS_HD Vec3<T> cross(const Vec3<T>& a, const Vec3<T>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T> BLITZGS_HD Vec3<T> load3(const T* p) { return {p[0], p[1], p[2]}; }
template <class T> BLITZGS_HD void store3(const Vec3<T>& a, T* p) {
  p[0] = a.x;
  p[1] = a.y;
  p[2] = a.z;
}

// False for NaN and for both infinities.
template <class T> BLITZGS_HD bool is_finite(T value) { return value - value == T(0); }
template <class T> BLITZGS_HD T larger(T a, T b) { return a > b ? a : b; }
template <class T> BLITZGS_HD T smaller(T a, T b) { return a < b ? a : b; }

}  // namespace blitzgs
