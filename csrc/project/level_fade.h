// SPDX-License-Identifier: Apache-2.0
// Smooth levels: the opacity of a Gaussian fades out towards the distance beyond which a view leaves out its
// octree level (view_gate.h), where the LOD gate alone would cut it off.
//
// weight(d) = clamp((1 - d^2 / reach^2) f / (f - 1), 0, 1) for a mean at distance d from the camera: 0 from
// `reach` on, 1 up to reach / sqrt(f), which is half a level nearer. Everything fainter by it follows from
// the faded opacity: the alpha of a pixel, which splats exist, and which tiles they touch. What the gate
// leaves out has the weight 0, so the gate before the projection saves work and changes nothing.
//
// A weight is a constant for the gradient of means and poses: it says what a view shows, not where the
// scene is. The opacity's gradient has it as a factor.
#pragma once
#include <cstdint>

#include "common/host_device.h"
#include "common/limits.h"

namespace blitzgs {

struct LevelFade {
  const std::uint8_t* level;         // [N]; null: nothing fades
  int n_levels;                      // a level beyond the last counts as the last
  float inverse_reach2[kMaxLevels];  // 1 / reach^2; 0: kept at any distance
};

BLITZGS_HD float inverse_reach2_of(const LevelFade& fade, std::int64_t id) {
  if (!fade.level) return 0.0f;
  const int level = fade.level[id], last = fade.n_levels - 1;
  return fade.inverse_reach2[level < last ? level : last];
}

}  // namespace blitzgs
