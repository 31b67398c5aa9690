// SPDX-License-Identifier: Apache-2.0
// The Morton codes of points (math/morton.h), without their lowest bit so that they fit a signed integer. A
// table whose rows are in this order has neighbours in space in neighbouring rows (blocks/blocks.h).
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs::BLITZGS_BACKEND {

// keys [n] of points [n, 3].
void morton_keys(const float* points, std::int64_t n, std::int64_t* keys, Workspace&, CudaStream);

}  // namespace blitzgs::BLITZGS_BACKEND
