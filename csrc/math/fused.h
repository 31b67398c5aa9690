// SPDX-License-Identifier: Apache-2.0
// Products and sums whose rounding no compiler option decides.
#pragma once
#include <cmath>

#include "common/host_device.h"

namespace blitzgs {

// a b + c. On a GPU the fused form is written out; on a CPU contraction is off, and fma() would be a library
// call.
template <class T>
BLITZGS_HD T mul_add(T a, T b, T c) {
#ifdef __CUDA_ARCH__
  return fma(a, b, c);
#else
  return a * b + c;
#endif
}

// A product that is added to something afterwards.
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
