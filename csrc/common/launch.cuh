// SPDX-License-Identifier: Apache-2.0
// Launches that avoid the gap of 1.2 to 2.5 us between two kernels of a stream (programmatic dependent
// launch, sm_90 and later). The device places a kernel that was launched by launch_early when all blocks of
// the kernel before it have ended, while that kernel's memory is still being flushed; the new kernel waits
// for the rest on the device. The rules for such kernels, and why they suffice:
//
// - Each of its blocks calls wait_for_earlier_kernels() before its first access to global memory, reads and
//   writes alike, and before any return: an earlier kernel may still read what this one would overwrite.
//   Before the call a block touches registers, shared memory and parameters only.
// - The call returns when the kernel before it has ended and its writes are visible. That kernel called
//   wait_for_earlier_kernels() itself, or was launched plainly and so began after all earlier kernels had
//   ended. Hence all earlier kernels have ended, and memory that was given back to the allocator and reused
//   in stream order is as safe as without early launches.
// - Only two neighbouring kernels overlap. Plain launches, copies and events wait until the kernel before
//   them has ended, and so does another stream that waits for such an event.
// - No kernel lets the next one in before its own blocks end (griddepcontrol.launch_dependents). A waiting
//   block occupies a multiprocessor, so a kernel that spins for another GPU or stream must not let its
//   successor in. Other kernels would only lose by it: blocks that are placed while others still run are
//   spread unevenly over the multiprocessors (docs/decisions/launch-earlier.md).
// - Kernels of other libraries are launched plainly; they wait for all earlier kernels by themselves.
#pragma once
#include <array>
#include <atomic>
#include <type_traits>

#include "common/branches.cuh"
#include "common/cuda_check.h"
#include "common/stream.h"

namespace blitzgs::cuda {

// A kernel that is launched by launch_early calls this first.
__device__ __forceinline__ void wait_for_earlier_kernels() {
#if BLITZGS_SM90
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Whether kernels wait on the current device. This depends on the code that the device runs and not on the
// device: code that was compiled for an older device and translated when it was loaded does not wait. All
// kernels are compiled for the same architectures, so asking one of them is enough.
inline bool kernels_wait(const void* kernel) {
  if constexpr (BLITZGS_SM80_BRANCHES) return false;
  enum : signed char { kUnknown, kNo, kYes };
  static std::array<std::atomic<signed char>, 64> known{};  // by device
  int device = 0;
  check(cudaGetDevice(&device), "launch");
  if (device >= static_cast<int>(known.size())) return false;
  signed char answer = known[device].load(std::memory_order_relaxed);
  if (answer == kUnknown) {
    cudaFuncAttributes code{};
    check(cudaFuncGetAttributes(&code, kernel), "launch");
    answer = code.ptxVersion >= 90 ? kYes : kNo;
    known[device].store(answer, std::memory_order_relaxed);
  }
  return answer == kYes;
}

struct LaunchShape {
  dim3 blocks;
  unsigned threads;
  CudaStream stream;
  std::size_t shared_bytes = 0;
};

// Launches a kernel that calls wait_for_earlier_kernels(). A failure names `what`.
template <class... Parameters>
void launch_early(const char* what, void (*kernel)(Parameters...), const LaunchShape& shape,
                  const std::type_identity_t<Parameters>&... arguments) {
  cudaLaunchAttribute early{};
  early.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  early.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = shape.blocks;
  config.blockDim = dim3(shape.threads);
  config.dynamicSmemBytes = shape.shared_bytes;
  config.stream = shape.stream;
  config.attrs = &early;
  config.numAttrs = kernels_wait(reinterpret_cast<const void*>(kernel)) ? 1 : 0;
  cudaLaunchKernelEx(&config, kernel, arguments...);
  check_launch(what);
}

}  // namespace blitzgs::cuda
