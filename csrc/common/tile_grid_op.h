// SPDX-License-Identifier: Apache-2.0
// The arguments that describe tiles, checked the same way in every op.
#pragma once
#include <limits>
#include <vector>

#include "common/op.h"
#include "math/tiles.h"

namespace blitzgs {

// numbers: n_cameras, width, height, tile_size, tile_begin, tile_end (-1: all tiles).
inline TileGrid checked_tile_grid(const char* op, const std::vector<std::int64_t>& numbers) {
  STD_TORCH_CHECK(numbers.size() == 6, "blitzgs::", op,
                  ": grid must be (n_cameras, width, height, tile_size, tile_begin, tile_end), got ",
                  numbers.size(), " numbers");
  const std::int64_t n_cameras = numbers[0], width = numbers[1], height = numbers[2], tile_size = numbers[3],
                     tile_begin = numbers[4], tile_end = numbers[5];
  constexpr std::int64_t kMost = std::numeric_limits<std::int32_t>::max();
  STD_TORCH_CHECK(n_cameras >= 0 && n_cameras <= kMost, "blitzgs::", op,
                  ": n_cameras must be at least 0, got ", n_cameras);
  STD_TORCH_CHECK(width > 0 && height > 0 && width <= (1 << 20) && height <= (1 << 20), "blitzgs::", op,
                  ": width and height must be in [1, 2^20], got ", width, " x ", height);
  STD_TORCH_CHECK(tile_size > 0 && tile_size <= 64, "blitzgs::", op, ": tile_size must be in [1, 64], got ",
                  tile_size);
  const TileGrid grid =
      make_tile_grid(static_cast<int>(n_cameras), static_cast<int>(width), static_cast<int>(height),
                     static_cast<int>(tile_size), tile_begin, tile_end);
  STD_TORCH_CHECK(0 <= grid.tile_begin && grid.tile_begin <= grid.tile_end && grid.tile_end <= grid.count(),
                  "blitzgs::", op, ": tile_begin and tile_end must be a range of the ", grid.count(),
                  " tiles, got [", tile_begin, ", ", tile_end, ")");
  return grid;
}

}  // namespace blitzgs
