// SPDX-License-Identifier: Apache-2.0
// The gradient of one splat, as compositing's backward pass adds it up on CUDA and the projection's backward
// pass reads it. This is the only definition of the layout: Python asks for it (the op
// splat_gradient_layout).
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/host_device.h"

namespace blitzgs {

struct alignas(16) SplatGradient {
  float mean2d[2], conic[3], opacity;
  float color[4];       // up to four channels, zero behind the last
  float mean2d_abs[2];  // sums of absolute values over pixels, where they were asked for

  BLITZGS_HD void add(const SplatGradient& v) {
    for (int i = 0; i < 2; ++i) mean2d[i] += v.mean2d[i];
    for (int i = 0; i < 3; ++i) conic[i] += v.conic[i];
    opacity += v.opacity;
    for (int i = 0; i < 3; ++i) color[i] += v.color[i];
    for (int i = 0; i < 2; ++i) mean2d_abs[i] += v.mean2d_abs[i];
  }
};

inline constexpr std::int64_t kSplatGradient = sizeof(SplatGradient) / sizeof(float);

// The same as three pieces of 16 bytes, which the rasteriser's kernels move; they rely on these places.
static_assert(kSplatGradient == 12 && offsetof(SplatGradient, conic) == 8 &&
              offsetof(SplatGradient, opacity) == 20 && offsetof(SplatGradient, color) == 24 &&
              offsetof(SplatGradient, mean2d_abs) == 40);

}  // namespace blitzgs
