// SPDX-License-Identifier: Apache-2.0
// Which vector instructions the CPU kernels use.
#pragma once
#include <cstdlib>

namespace blitzgs {

// Whether to use AVX2 and FMA: true where the processor has them, unless BLITZGS_NO_AVX2 is set in the
// environment (read once). The plain code gives the same bits, and a test compares both.
inline bool use_avx2() {
  static const bool use = std::getenv("BLITZGS_NO_AVX2") == nullptr && __builtin_cpu_supports("avx2") &&
                          __builtin_cpu_supports("fma");
  return use;
}

}  // namespace blitzgs
