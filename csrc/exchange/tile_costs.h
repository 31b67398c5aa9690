// SPDX-License-Identifier: Apache-2.0
// The costs of the tiles of a batch, on the host: how they are stored for each view, and the division of the
// tiles among ranks that follows from them. On CUDA, too, the costs are in the memory of the host.
//
// A view of T tiles has ceil(T / grain) stored costs, its pieces: float16 means over `grain` consecutive
// tiles; the last piece may have fewer. Costs are >= 0.
//
// Every rank computes the division by itself, so its sums must not depend on the order of the additions. They
// do not for a tile cost of at least 8: each cost is then a float in [8, 2^17), which is a multiple of 2^-20,
// and doubles add these up without rounding to 2^33. A mean over fewer than 2^8 tiles is stored without
// dependence on the order for the same reason: sums of integers are exact below 2^24, and larger means exceed
// the largest float16, 65504, which is stored for them.
#pragma once
#include "common/kernel.h"

namespace blitzgs::cpu {

// costs [tiles] -> pieces [ceil(tiles / grain)], float16, rounded to nearest even, at most 65504.
void store_tile_costs(const float* costs, int64_t tiles, int64_t grain, uint16_t* pieces);

// The views of a batch, of `tiles` tiles each. A view without pieces (null) has the mean cost of the views
// `similar`, added up in their order in floats; without any, zeros. `tile_cost` is added to each.
struct BatchCosts {
  const uint16_t* const* views;
  int64_t n_views;
  const uint16_t* const* similar;
  int64_t n_similar;
  int64_t tiles, grain;
  float tile_cost;
};

// Cuts the tiles of the batch, one view after the other, into `parts` contiguous ranges of nearly equal cost.
// bounds [parts + 1] ascend from 0 to n_views * tiles; each is the one nearest to its share of the total, the
// later one of two.
void divide_tiles(const BatchCosts& costs, int64_t parts, Workspace& workspace, int64_t* bounds);

}  // namespace blitzgs::cpu
