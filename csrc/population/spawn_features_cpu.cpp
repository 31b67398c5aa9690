// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "population/spawn_features.h"

namespace blitzgs::cpu {

void spawn_features(const SpawnFeaturesArgs& args, CudaStream) {
  parallel_for(0, args.n_candidates, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t candidate = begin; candidate < end; ++candidate) spawn_features_of(args, candidate);
  });
}

}  // namespace blitzgs::cpu
