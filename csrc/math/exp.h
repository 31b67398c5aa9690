// SPDX-License-Identifier: Apache-2.0
// 2^x for CPU kernels, written once over the lane types of math/lanes.h: scalar and AVX2 code do the same
// operations in the same order, hence the same bits.
#pragma once

namespace blitzgs {

// 2^x for x <= 0, relative error below 1.1e-7 (1 ulp). x below -126 counts as -126, because no kernel needs
// smaller results. NaN stays NaN.
//
// x is split into n + f with n the nearest integer. A minimax polynomial of degree 6 gives 2^f on [-1/2, 1/2]
// (relative error 2e-9), and n is added to the exponent bits.
template <class Lanes>
inline Lanes exp2_nonpositive(Lanes x) {
  const Lanes clamped = Lanes::max(Lanes::broadcast(-126.0f), x);
  const Lanes n = Lanes::round(clamped);
  const Lanes f = clamped - n;
  Lanes p = Lanes::fma(Lanes::broadcast(1.5345811984583603e-4f), f, Lanes::broadcast(1.3399931218929e-3f));
  p = Lanes::fma(p, f, Lanes::broadcast(9.618488957179101e-3f));
  p = Lanes::fma(p, f, Lanes::broadcast(5.550328776965966e-2f));
  p = Lanes::fma(p, f, Lanes::broadcast(2.4022646890633564e-1f));
  p = Lanes::fma(p, f, Lanes::broadcast(6.931472057372674e-1f));
  p = Lanes::fma(p, f, Lanes::broadcast(1.0f));
  return Lanes::scale_exponent(p, n);
}

}  // namespace blitzgs
