// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "render/render.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// One thread per pixel.
__global__ void __launch_bounds__(kThreads)
    alphas_kernel(const float* transmittances, std::int64_t n, float* alphas) {
  wait_for_earlier_kernels();
  const std::int64_t i = blockIdx.x * std::int64_t{kThreads} + threadIdx.x;
  if (i < n) alphas[i] = 1.f - transmittances[i];
}

}  // namespace

template <>
void alphas_of<float>(const float* transmittances, std::int64_t n, float* alphas, CudaStream stream) {
  if (n == 0) return;
  launch_early("render", alphas_kernel, {blocks_for(n, kThreads), kThreads, stream}, transmittances, n,
               alphas);
}

}  // namespace blitzgs::cuda
