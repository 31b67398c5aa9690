// SPDX-License-Identifier: Apache-2.0
// The features of candidates of densification, from which the spawn gate predicts whether their children
// survive (BlitzGS, section 3.2). The columns are those of blitzgs.spawn.candidates.FEATURES.
//
//   columns of a table with N rows (SpawnFeatures), rows int64 [M], is_split bool [M]
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

struct SpawnFeatures {
  const float* grad_sum;           // [N], sum of gradient norms since the last density event
  const std::int32_t* grad_count;  // [N], number of these gradients
  const float* opacities;          // [N], logits
  const float* scales;             // [N, 3], logarithms
  const std::int32_t* birth;       // [N], in images
  const std::uint8_t* level;       // [N], octree level
  const float* color_moments;      // [N, K, 3], Adam's mean squared gradients of the SH coefficients
  std::int64_t color_stride;       // 3 K
  const std::int64_t* rows;        // [M], in [0, N)
  const bool* is_split;            // [M]
  std::int64_t n, time;            // time: of the event, in images
  double extent;                   // of the scene
  int level_count;
  float* features;

  BLITZGS_HD void operator()(std::int64_t candidate) const {
    const std::int64_t row = rows[candidate];
    const int views = grad_count[row], own_level = level[row];
    const float* const log_scale = scales + 3 * row;
    const double x = log_scale[0], y = log_scale[1], z = log_scale[2];
    const float* const moments = color_moments + color_stride * row;
    const double color = (double{moments[0]} + moments[1] + moments[2]) / 3;
    const bool splits = is_split[candidate];
    float* const out = features + kSpawnFeatures * candidate;
    out[0] = grad_sum[row] / static_cast<float>(views > 1 ? views : 1);
    out[1] = static_cast<float>(sigmoid(static_cast<double>(opacities[row])));
    out[2] = static_cast<float>((std::exp(x) + std::exp(y) + std::exp(z)) / 3 / extent);
    out[3] = static_cast<float>(time - birth[row]);
    out[4] = static_cast<float>(views);
    out[5] = static_cast<float>(splits ? smaller(own_level + 1, level_count - 1) : own_level);
    out[6] = static_cast<float>(time);
    out[7] = splits;
    out[8] = static_cast<float>(std::sqrt(color));
    out[9] = static_cast<float>(std::exp(smaller(x, smaller(y, z)) - larger(x, larger(y, z))));
  }
};

}  // namespace blitzgs
