// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "common/cuda.cuh"
#include "population/sampling.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 512, kResident = 4;  // blocks per multiprocessor

// keys [n] (sampling.h), one thread per item.
__global__ void __launch_bounds__(kThreads) sampling_keys_kernel(const SamplingKeys args) {
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i < args.n) args.keys[i] = sampling_key(args, i);
}

// Adds to counts [2^width] (sampling.h), one thread per key in a grid-stride loop. A block counts in shared
// memory first.
__global__ void __launch_bounds__(kThreads) key_histogram_kernel(const KeyHistogram args) {
  __shared__ unsigned counts[1 << kMaxDigitBits];
  const int digits = 1 << args.width;
  for (int i = threadIdx.x; i < digits; i += kThreads) counts[i] = 0;
  __syncthreads();
  const std::int64_t prefix = *args.prefix, stride = gridDim.x * std::int64_t{kThreads};
  for (std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x; i < args.n; i += stride) {
    const int digit = digit_of(args, prefix, args.keys[i]);
    if (digit >= 0) atomicAdd(counts + digit, 1u);
  }
  __syncthreads();
  for (int i = threadIdx.x; i < digits; i += kThreads) {
    if (counts[i] > 0) atomicAdd(reinterpret_cast<unsigned long long*>(args.counts + i), counts[i]);
  }
}

}  // namespace

void sampling_keys(const SamplingKeys& args, CudaStream stream) {
  if (args.n == 0) return;
  sampling_keys_kernel<<<blocks_for(args.n, kThreads), kThreads, 0, stream>>>(args);
  check_launch("sampling_keys");
}

void key_histogram(const KeyHistogram& args, CudaStream stream) {
  check(cudaMemsetAsync(args.counts, 0, sizeof(*args.counts) << args.width, stream), "key_histogram");
  if (args.n == 0) return;
  const auto blocks =
      std::min(blocks_for(args.n, kThreads), static_cast<unsigned>(kResident * multiprocessors()));
  key_histogram_kernel<<<blocks, kThreads, 0, stream>>>(args);
  check_launch("key_histogram");
}

}  // namespace blitzgs::cuda
