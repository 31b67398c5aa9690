// SPDX-License-Identifier: Apache-2.0
// The op list_and_rasterize is intersect (intersect.h), then rasterize_fwd (rasterize.h), then this kernel:
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
