// SPDX-License-Identifier: Apache-2.0
// The checked places of scattered splats, for the ops that read values that come back from ranks.
#pragma once
#include "common/op.h"
#include "exchange/places.h"

namespace blitzgs {

// The places [runs, n_ranks] that scatter_splats returned, checked and contiguous.
inline Tensor checked_places(const char* op, const Tensor& places, std::int64_t splats,
                             std::int64_t n_ranks) {
  return checked<std::int64_t>(op, "places", places, {place_runs(splats), n_ranks});
}

inline const SplatPlace* places_in(const Tensor& places) {
  return reinterpret_cast<const SplatPlace*>(data<std::int64_t>(places));
}

}  // namespace blitzgs
