// SPDX-License-Identifier: Apache-2.0
// The features of candidates of densification, from which the spawn gate predicts whether their children
// survive (BlitzGS, section 3.2). The columns are those of blitzgs.spawn.candidates.FEATURES.
//
//   columns of a table with N rows (SpawnFeaturesArgs), rows int64 [M], is_split bool [M]
//   ->  features float32 [M, kSpawnFeatures]
//
// A feature is computed in float64 and rounded once, so that CPU and CUDA agree but for rare differences in
// the last bit. One thread per candidate. The cost is O(M).
#pragma once
#include <cmath>
#include <cstdint>

#include "common/kernel.h"
#include "math/gaussian.h"

namespace blitzgs {

constexpr int kSpawnFeatures = 10;

struct SpawnFeaturesArgs {
  const float* grad_sum;            // [N], sum of gradient norms since the last density event
  const std::int32_t* grad_count;   // [N], number of these gradients
  const float* opacities;           // [N], logits
  const float* scales;              // [N, 3], logarithms
  const std::int32_t* birth;        // [N], in images
  const std::uint8_t* level;        // [N], octree level
  const float* color_moments;       // [N, K, 3], Adam's mean squared gradients of the SH coefficients
  std::int64_t color_stride;        // 3 K
  const std::int64_t* rows;         // [M], in [0, N)
  const bool* is_split;             // [M]
  std::int64_t n_candidates, time;  // time: of the event, in images
  double extent;                    // of the scene
  int level_count;
  float* features;
};

BLITZGS_HD void spawn_features_of(const SpawnFeaturesArgs& args, std::int64_t candidate) {
  const std::int64_t row = args.rows[candidate];
  const int views = args.grad_count[row], level = args.level[row];
  const float* const scales = args.scales + 3 * row;
  const double x = scales[0], y = scales[1], z = scales[2];
  const float* const moments = args.color_moments + args.color_stride * row;
  const double color = (double{moments[0]} + moments[1] + moments[2]) / 3;
  const bool is_split = args.is_split[candidate];
  float* const out = args.features + kSpawnFeatures * candidate;
  out[0] = args.grad_sum[row] / static_cast<float>(views > 1 ? views : 1);
  out[1] = static_cast<float>(sigmoid(static_cast<double>(args.opacities[row])));
  out[2] = static_cast<float>((std::exp(x) + std::exp(y) + std::exp(z)) / 3 / args.extent);
  out[3] = static_cast<float>(args.time - args.birth[row]);
  out[4] = static_cast<float>(views);
  out[5] = static_cast<float>(is_split ? smaller(level + 1, args.level_count - 1) : level);
  out[6] = static_cast<float>(args.time);
  out[7] = is_split;
  out[8] = static_cast<float>(std::sqrt(color));
  out[9] = static_cast<float>(std::exp(smaller(x, smaller(y, z)) - larger(x, larger(y, z))));
}

namespace BLITZGS_BACKEND {
void spawn_features(const SpawnFeaturesArgs& args, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
