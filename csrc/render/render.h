// SPDX-License-Identifier: Apache-2.0
// The op render is what follows the projection of a call: the colours of the splats from gathered rows
// (color_rows.h, project.h), intersect (intersect.h), rasterize_fwd (rasterize.h), and this kernel:
// alphas[i] = 1 - transmittances[i], 0 <= i < n.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

namespace BLITZGS_BACKEND {
template <class T>
void alphas_of(const T* transmittances, std::int64_t n, T* alphas, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
