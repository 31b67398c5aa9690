// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "population/spawn_features.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 256;

// The features (spawn_features.h), one thread per candidate.
__global__ void __launch_bounds__(kThreads) spawn_features_kernel(const SpawnFeaturesArgs args) {
  wait_for_earlier_kernels();
  const std::int64_t candidate = static_cast<std::int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (candidate < args.n_candidates) spawn_features_of(args, candidate);
}

}  // namespace

void spawn_features(const SpawnFeaturesArgs& args, CudaStream stream) {
  if (args.n_candidates == 0) return;
  launch_early("spawn_features", spawn_features_kernel,
               {blocks_for(args.n_candidates, kThreads), kThreads, stream}, args);
}

}  // namespace blitzgs::cuda
