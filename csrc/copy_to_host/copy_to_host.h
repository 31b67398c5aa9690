// SPDX-License-Identifier: Apache-2.0
// Numbers for the host, written into its pinned memory by the kernels themselves. CUDA only. A copy is done
// by another engine of the GPU, which costs the stream a wait before and after it; a store costs nothing.
// They are there once the host has waited for the kernel.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs::cuda {

// Where kernels of the current device find pinned memory of the host. Throws where it is not pinned.
std::int64_t* device_address(std::int64_t* pinned);

void copy_to_host(const std::int64_t* values, std::int64_t n, std::int64_t* host, CudaStream);

}  // namespace blitzgs::cuda
