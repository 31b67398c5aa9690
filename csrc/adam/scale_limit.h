// SPDX-License-Identifier: Apache-2.0
// A limit of the size of Gaussians, which grows with their distance from the scene.
//
// For every listed row i:
//   scales[i] = min(scales[i], log(share * max(extent, |means[i]|)))
//
// Without it, the cheapest way to cover what few photographs show is a Gaussian larger than the scene, far
// behind it. Splats are ordered by the depths of their centres, so such a Gaussian hides the scene from
// places where no photograph was taken.
//
// means [N, 3], with the middle of the cameras at the origin; scales [N, 3] (log); visible_ids int32 [U]
// (each row once). The scales are updated in place, one thread per row: deterministic. The cost is O(U).
#pragma once
#include "math/vec.h"

namespace blitzgs {

template <class T> struct ScaleLimit {
  T* scales;       // [N, 3]
  const T* means;  // [N, 3]
  const int32_t* visible_ids;
  int64_t n;
  T share, extent;

  BLITZGS_HD void operator()(int64_t u) const {
    const int64_t row = visible_ids[u];
    const Vec3<T> mean = load3(means + 3 * row);
    const T distance = std::sqrt(dot(mean, mean));
    const T limit = std::log(share * (distance > extent ? distance : extent));
    for (int axis = 0; axis < 3; ++axis) {
      T& scale = scales[3 * row + axis];
      if (scale > limit) scale = limit;
    }
  }
};

}  // namespace blitzgs
