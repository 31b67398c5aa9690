// SPDX-License-Identifier: Apache-2.0
#include "adam/position_noise.h"
#include "common/cuda.cuh"

namespace blitzgs::cuda {

namespace {
// Adds the noise (position_noise.h) to the means, one thread per visible Gaussian.
template <class T>
__global__ void position_noise_kernel(const PositionNoiseArgs<T> args) {
  const std::int64_t u = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (u < args.visible) position_noise_of(args, u);
}
}  // namespace

template <class T>
void position_noise(const PositionNoiseArgs<T>& args, Workspace&, CudaStream stream) {
  if (args.visible == 0) return;
  position_noise_kernel<<<blocks_for(args.visible, 256), 256, 0, stream>>>(args);
  check_launch("position_noise");
}

template void position_noise<float>(const PositionNoiseArgs<float>&, Workspace&, CudaStream);

}  // namespace blitzgs::cuda
