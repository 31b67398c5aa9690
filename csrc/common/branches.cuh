// SPDX-License-Identifier: Apache-2.0
// Where the GPU or the size of the work decides which code runs. A test build takes the other branch on the
// machine at hand: BLITZGS_SM80_BRANCHES compiles the code of GPUs before sm_90 for all of them, and
// BLITZGS_SMALL_STATES lowers the number of items from which sorts take 64-bit states (docs/testing.md). A
// library says what it was compiled with (branches_cuda.cu).
#pragma once
#include <cstdint>

#ifndef BLITZGS_SM80_BRANCHES
#define BLITZGS_SM80_BRANCHES 0
#endif
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900 && !BLITZGS_SM80_BRANCHES
#define BLITZGS_SM90 1
#else
#define BLITZGS_SM90 0
#endif

#ifndef BLITZGS_SMALL_STATES
#define BLITZGS_SMALL_STATES (1 << 30)  // 32-bit states leave 30 bits for counts
#endif

namespace blitzgs::cuda {

// Sorts of fewer items have 32-bit states.
inline constexpr std::int64_t kSmallStates = BLITZGS_SMALL_STATES;
static_assert(kSmallStates <= 1 << 30);

}  // namespace blitzgs::cuda
