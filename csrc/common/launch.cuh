// SPDX-License-Identifier: Apache-2.0
// Launches without the gap between two kernels of a stream, 1.2 to 2.5 us otherwise (sm_90 and later:
// programmatic dependent launch). A kernel launched by launch_early is placed once all blocks of the one in
// front of it have ended, while that one's memory is still being flushed, and waits for the rest on the
// device. What it owes for that, and why no more is needed:
//
// - Each of its blocks calls wait_for_earlier_kernels() before its first access to global memory, reads and
//   writes alike, and before any return: what it would overwrite may still be read. In front of the call
//   stands at most what touches registers, shared memory and parameters.
// - The call returns when the kernel in front has ended and its writes are visible. That one waited itself,
//   or was launched plainly and then began after all before it had ended: so everything in front has ended.
//   Memory given back to the allocator and reused in stream order is therefore as safe as ever.
// - Only the launches of two neighbouring kernels overlap. Plain launches, copies and events begin or are
//   reached when the kernel in front has ended; through an event, another stream sees no less.
// - No kernel lets the next one in before its own blocks end (griddepcontrol.launch_dependents). A waiting
//   block holds a place, so one that spins for another GPU or stream (peers_cuda.cu) must not let its
//   successor in; and the others are slower for it: what is placed while blocks still run is spread unevenly
//   over the multiprocessors (docs/performance.md).
// - Kernels of other libraries stay as they are; launched plainly, they wait for all in front, as the call
//   does for them.
#pragma once
#include <array>
#include <atomic>
#include <type_traits>

#include "common/cuda_check.h"
#include "common/stream.h"

namespace blitzgs::cuda {

// The first thing that a kernel does that is launched by launch_early.
__device__ __forceinline__ void wait_for_earlier_kernels() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
}

// Whether kernels wait on the current device. Asked of the code that it runs, not of the device: code for an
// older one, translated when it is loaded, does not. All kernels are compiled for the same architectures.
inline bool kernels_wait(const void* kernel) {
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

// Launches a kernel that waits; `what` is named where it fails.
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
