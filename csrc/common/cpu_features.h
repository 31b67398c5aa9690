// SPDX-License-Identifier: Apache-2.0
// Which vector instructions the CPU kernels use.
#pragma once

namespace blitzgs {

// AVX2 and FMA, where the processor has them. BLITZGS_NO_AVX2 in the environment (read once) forbids them:
// the plain code gives the same bits, which a test relies on.
bool use_avx2();

}  // namespace blitzgs
