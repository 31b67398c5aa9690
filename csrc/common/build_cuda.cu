// SPDX-License-Identifier: Apache-2.0
// How this library was built: for `blitzgs doctor`, and for tests, which branches of cuda.cuh it takes.

#include "common/cuda.cuh"

namespace {
// Each architecture in the library has its own value; a device reads the value of the code that it runs.
__device__ const int sm90_branches = BLITZGS_SM90;
}  // namespace

extern "C" {

// Returns the version of CUDA and the GPUs (cmake/cuda.cmake).
__attribute__((visibility("default"))) const char* blitzgs_cuda_build() { return BLITZGS_CUDA_BUILD; }

// Returns whether the code that the current device runs has the branches for sm_90; -1 without a device.
__attribute__((visibility("default"))) int blitzgs_sm90_branches() {
  int answer = -1;
  return cudaMemcpyFromSymbol(&answer, sm90_branches, sizeof(answer)) == cudaSuccess ? answer : -1;
}

// Returns 1 if this build has no branches for sm_90 on any device, otherwise 0.
__attribute__((visibility("default"))) int blitzgs_sm80_forced() { return BLITZGS_SM80_BRANCHES; }

// Returns the number of items from which sorts take 64-bit states.
__attribute__((visibility("default"))) int64_t blitzgs_small_states() { return blitzgs::cuda::kSmallStates; }

}  // extern "C"
