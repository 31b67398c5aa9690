// SPDX-License-Identifier: Apache-2.0
// Numbers that kernels write to pinned memory of the host themselves (CUDA only). A cudaMemcpyAsync would be
// done by another engine of the GPU, and the stream would wait before and after it; a store by a kernel has
// no such wait. The host may read the numbers after it has waited for the kernel.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs::cuda {

// The address at which kernels of the current device access pinned memory of the host. Throws if the memory
// is not pinned.
std::int64_t* device_address(std::int64_t* pinned);

void copy_to_host(const std::int64_t* values, std::int64_t n, std::int64_t* host, CudaStream);

}  // namespace blitzgs::cuda
