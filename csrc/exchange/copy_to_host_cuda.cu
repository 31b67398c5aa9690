// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "exchange/copy_to_host.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 128;

// host [n] = values [n], one thread per value.
__global__ void copy_kernel(const std::int64_t* values, std::int64_t n, std::int64_t* host) {
  wait_for_earlier_kernels();
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i < n) host[i] = values[i];
}

}  // namespace

std::int64_t* device_address(std::int64_t* pinned) {
  cudaPointerAttributes found{};
  check(cudaPointerGetAttributes(&found, pinned), "pinned memory");
  if (found.type != cudaMemoryTypeHost || !found.devicePointer) {
    throw std::runtime_error("blitzgs: what the GPU is to write for the host must be pinned memory");
  }
  return static_cast<std::int64_t*>(found.devicePointer);
}

void copy_to_host(const std::int64_t* values, std::int64_t n, std::int64_t* host, CudaStream stream) {
  if (n == 0) return;
  launch_early("copy_to_host", copy_kernel, {blocks_for(n, kThreads), kThreads, stream}, values, n,
               device_address(host));
}

}  // namespace blitzgs::cuda
