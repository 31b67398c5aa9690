// SPDX-License-Identifier: Apache-2.0
// The statistics of density control (Kerbl et al. 2023, section 5), summed over the views of one step.
//
// For every visible Gaussian g and each of its splats r (g in one view):
//   grad_sum[g]   += phi[g] * weight * |(v_means2d[r].x * width / 2, v_means2d[r].y * height / 2)|
//   grad_count[g] += 1
//   max_radii[g]   = max(max_radii[g], ceil(3 sqrt(largest eigenvalue of the 2D covariance))), in pixels
// With the mean m and the product d of the eigenvalues, the largest is m + sqrt(max(0.1, m^2 - d)), as in the
// original renderer.
//
// v_means2d [P, 2] is the gradient by the pixel position; the values of consecutive splats are v_stride
// numbers apart. weight is the factor from the gradient of the batch's loss to the gradient of one view's
// loss (B for a mean over B views). phi [N] or null (1); conics [P, 3] inverse covariance (a, b, c);
// visible_ids int32 [U], splat_offsets int32 [U + 1]. The statistics are updated in place. One thread sums
// over the splats of a Gaussian in order, so the result is deterministic. The cost is O(P).
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "common/kernel.h"
#include "math/tiles.h"

namespace blitzgs {

// The radius of a splat in pixels, three standard deviations of its longer axis; 0 for a conic whose diagonal
// is not positive. In double, because the determinant of a thin splat's conic is a small difference. If that
// is less than the rounding of the conic's own numbers, the rounding takes its place: the splat is then at
// least so long, and not mistaken for a small one.
template <class T>
BLITZGS_HD T three_sigma_radius(const T* conic) {
  constexpr double kRounding = std::numeric_limits<T>::epsilon();
  const double a = static_cast<double>(conic[0]), c = static_cast<double>(conic[2]);
  if (!(a > 0 && c > 0)) return 0;
  const double found = conic_determinant(conic), least = kRounding * a * c;
  const double determinant = found > least ? found : least;
  const double half_trace = 0.5 * (a + c) / determinant;
  const double gap = half_trace * half_trace - 1 / determinant;
  return static_cast<T>(std::ceil(3 * std::sqrt(half_trace + std::sqrt(gap > 0.1 ? gap : 0.1))));
}

template <class T>
struct DensityStats {
  T* grad_sum;               // [N]
  std::int32_t* grad_count;  // [N]
  T* max_radii;              // [N]
  const std::int32_t* visible_ids;
  const std::int32_t* splat_offsets;
  const T* v_means2d;
  std::int64_t v_stride;
  const T* conics;
  const T* phi;
  std::int64_t n;
  T half_width, half_height, weight;

  BLITZGS_HD void operator()(std::int64_t u) const {
    const std::int32_t id = visible_ids[u];
    const std::int32_t begin = splat_offsets[u], end = splat_offsets[u + 1];
    T sum = 0, radius = max_radii[id];
    for (std::int32_t r = begin; r < end; ++r) {
      const T* v = v_means2d + r * v_stride;
      const T x = v[0] * half_width, y = v[1] * half_height;
      sum += std::sqrt(x * x + y * y);
      const T reach = three_sigma_radius(conics + 3 * std::int64_t{r});
      radius = reach > radius ? reach : radius;
    }
    grad_sum[id] += (phi ? phi[id] : T(1)) * weight * sum;
    grad_count[id] += end - begin;
    max_radii[id] = radius;
  }
};

}  // namespace blitzgs
