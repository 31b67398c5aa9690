// SPDX-License-Identifier: Apache-2.0
// Products and sums whose rounding does not depend on compiler options.
#pragma once
#include <cmath>

#include "common/host_device.h"

namespace blitzgs {

// a b + c. On a GPU this is a fused multiply-add. On a CPU the compiler must not contract products (the build
// says so), and fma() would be a library call.
template <class T>
BLITZGS_HD T mul_add(T a, T b, T c) {
#ifdef __CUDA_ARCH__
  return fma(a, b, c);
#else
  return a * b + c;
#endif
}

// A product that will be added to something: the compiler may not fuse it with that addition.
template <class T>
BLITZGS_HD T mul(T a, T b) {
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

}  // namespace blitzgs
