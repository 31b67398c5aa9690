// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "exchange/transport.h"

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

namespace {

constexpr int kBarrierThreads = 128;

__device__ std::uint64_t nanoseconds() {
  std::uint64_t now;
  asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
  return now;
}

__device__ void announce(std::int64_t* flag, std::int64_t number) {
  asm volatile("st.release.sys.global.s64 [%0], %1;" ::"l"(flag), "l"(number) : "memory");
}

__device__ std::int64_t look(const std::int64_t* flag) {
  std::int64_t number;
  asm volatile("ld.acquire.sys.global.s64 %0, [%1];" : "=l"(number) : "l"(flag) : "memory");
  return number;
}

// The device barrier (transport.h), one block. It first writes this rank's values to all peers. Thread m then
// tells peer m that this rank has arrived, and waits until peer m has. At last the block sums the values of
// all ranks and writes them to the host's memory, which saves a launch.
__global__ void __launch_bounds__(kBarrierThreads)
    barrier_kernel(const ControlWords control, std::int64_t number, const std::int64_t* values, int n_values,
                   std::int64_t first, std::uint64_t timeout, std::int64_t* host) {
  for (int i = threadIdx.x; i < control.count * n_values; i += kBarrierThreads) {
    const int m = i / n_values, k = i - m * n_values;
    control.of[m][first + control.rank * n_values + k] = values[k];
  }
  __threadfence_system();
  __syncthreads();
  const int peer = threadIdx.x;
  if (peer < control.count) {
    announce(control.of[peer] + control.rank, number);
    const std::uint64_t start = nanoseconds();
    while (look(control.of[control.rank] + peer) < number) {
      if (nanoseconds() - start > timeout) __trap();
    }
  }
  if (n_values == 0) return;
  __syncthreads();
  std::int64_t* brought = control.of[control.rank] + first;
  for (int k = threadIdx.x; k < n_values; k += kBarrierThreads) {
    std::int64_t sum = 0;
    for (int m = 0; m < control.count; ++m) {
      const std::int64_t value = brought[m * n_values + k];
      sum += value;
      if (host) host[m * n_values + k] = value;
    }
    brought[control.count * n_values + k] = sum;
  }
}

}  // namespace

void device_barrier(const ControlWords& control, std::int64_t number, const std::int64_t* values,
                    int n_values, std::int64_t first, double timeout_seconds, std::int64_t* host, Workspace&,
                    CudaStream stream) {
  const auto timeout = static_cast<std::uint64_t>(1e9 * timeout_seconds);
  barrier_kernel<<<1, kBarrierThreads, 0, stream>>>(control, number, values, n_values, first, timeout,
                                                    host ? device_address(host) : nullptr);
  check_launch("device_barrier");
}

}  // namespace blitzgs::cuda
