// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "loss/loss_of_sums.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 512;

// The loss (loss_of_sums.h), by one block.
__global__ void __launch_bounds__(kThreads) loss_of_sums_kernel(const LossOfSums<float> args) {
  double l1 = 0, ssim = 0;
  for (std::int64_t i = threadIdx.x; i < args.n; i += kThreads) {
    l1 += args.parts[2 * i], ssim += args.parts[2 * i + 1];
  }
  l1 = block_sum<kThreads>(l1), ssim = block_sum<kThreads>(ssim);
  if (threadIdx.x > 0) return;
  *args.loss = static_cast<float>(args.offset + args.l1_weight * l1 + args.ssim_weight * ssim);
}

}  // namespace

template <>
void loss_of_sums<float>(const LossOfSums<float>& args, Workspace&, CudaStream stream) {
  loss_of_sums_kernel<<<1, kThreads, 0, stream>>>(args);
  check_launch("loss_of_sums");
}

}  // namespace blitzgs::cuda
