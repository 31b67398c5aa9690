// SPDX-License-Identifier: Apache-2.0
#include "common/cpu_features.h"

#include <cstdlib>

namespace blitzgs {

bool use_avx2() {
  static const bool use = std::getenv("BLITZGS_NO_AVX2") == nullptr && __builtin_cpu_supports("avx2") &&
                          __builtin_cpu_supports("fma");
  return use;
}

}  // namespace blitzgs
