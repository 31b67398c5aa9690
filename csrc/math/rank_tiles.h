// SPDX-License-Identifier: Apache-2.0
// Which ranks need a splat: each rank composites a range of the flattened tiles of all cameras
// (math/tiles.h).
#pragma once
#include <cstdint>

#include "common/host_device.h"
#include "common/limits.h"

namespace blitzgs {

// Rank m composites tiles [begin[m], end[m]). Ranges may be empty and may overlap; their begins ascend.
struct RankTiles {
  std::int64_t begin[kMaxRanks], end[kMaxRanks];
  int n_ranks;
};

// Calls f(rank, tiles) for each rank that composites some of the tiles [begin, end).
template <class F>
BLITZGS_HD void for_each_rank(const RankTiles& ranks, std::int64_t begin, std::int64_t end, const F& f) {
  for (int m = 0; m < ranks.n_ranks && ranks.begin[m] < end; ++m) {
    const std::int64_t low = ranks.begin[m] > begin ? ranks.begin[m] : begin;
    const std::int64_t high = ranks.end[m] < end ? ranks.end[m] : end;
    if (low < high) f(m, high - low);
  }
}

}  // namespace blitzgs
