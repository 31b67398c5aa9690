// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "importance/view_sums.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 256;

struct ToNearest {
  __device__ std::int64_t operator()(double value) const { return __double2ll_rn(value); }
};

// Adds to the sums (view_sums.h), one thread per visible Gaussian.
__global__ void __launch_bounds__(kThreads) view_sums_kernel(const ViewSumsArgs args) {
  wait_for_earlier_kernels();
  const std::int64_t u = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (u < args.n_visible) view_sums_of(args, u, ToNearest{});
}

}  // namespace

void view_sums(const ViewSumsArgs& args, CudaStream stream) {
  if (args.n_visible == 0) return;
  launch_early("view_sums", view_sums_kernel, {blocks_for(args.n_visible, kThreads), kThreads, stream}, args);
}

}  // namespace blitzgs::cuda
