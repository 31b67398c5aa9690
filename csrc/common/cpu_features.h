// SPDX-License-Identifier: Apache-2.0
// Which vector instructions the CPU kernels use.
#pragma once

namespace blitzgs {

// Whether to use AVX2 and FMA: true where the processor has them, unless BLITZGS_NO_AVX2 is set in the
// environment (read once). The plain code gives the same bits, and a test compares both.
bool use_avx2();

}  // namespace blitzgs
