// SPDX-License-Identifier: Apache-2.0
#include "route/route.h"

#include <cstdlib>
#include <vector>

#include "common/catch.h"

using namespace blitzgs;

namespace {
struct NoWorkspace final : Workspace {
  void* allocate_bytes(std::size_t) override { std::abort(); }
};
}  // namespace

TEST_CASE("route sends a row exactly to the ranks whose tiles it touches", "[route]") {
  const int width = 160, height = 112, tile_size = 16, cameras = 2;
  TileGrid grid = make_tile_grid(cameras, width, height, tile_size, 0, -1);
  const std::int64_t n_tiles = grid.count();
  std::vector<float> means, conics, opacities;
  std::vector<std::int32_t> camera_ids;
  for (int i = 0; i < 400; ++i) {
    means.insert(means.end(),
                 {static_cast<float>((i * 37) % 200 - 20), static_cast<float>((i * 53) % 150 - 20)});
    const float sharp = 0.002f * static_cast<float>(1 + i % 40);
    conics.insert(conics.end(), {sharp, sharp * 0.4f, sharp * 2});
    opacities.push_back(i % 9 == 0 ? 0.001f : 0.5f);  // some touch nothing
    camera_ids.push_back(i % cameras);
  }
  const std::int64_t n = static_cast<std::int64_t>(camera_ids.size());
  // Rank 1 has nothing; rank 2 crosses from one image to the next and overlaps both its neighbours.
  const RankTiles ranks{{0, 2, 2, 89}, {24, 2, 100, n_tiles}, 4};
  const RouteInput<float> in{means.data(), conics.data(), opacities.data(), camera_ids.data(), n,
                             grid,         ranks};
  std::vector<std::int64_t> masks(n), counts(8, -1);
  NoWorkspace workspace;
  cpu::route_count(in, masks.data(), counts.data(), workspace, nullptr);

  std::vector<std::int64_t> expected(8, 0);
  for (std::int64_t row = 0; row < n; ++row) {
    std::int64_t mask = 0;
    for_each_tile(&means[2 * row], &conics[3 * row], opacities[row], width, height, tile_size,
                  [&](int tx, int ty) {
                    const std::int64_t tile = camera_ids[row] * grid.per_image() + ty * grid.tiles_x + tx;
                    for (int m = 0; m < 4; ++m) {
                      if (tile < ranks.begin[m] || tile >= ranks.end[m]) continue;
                      mask |= std::int64_t{1} << m;
                      ++expected[2 * m + 1];
                    }
                  });
    REQUIRE(masks[row] == mask);
    for (int m = 0; m < 4; ++m) expected[2 * m] += (mask >> m) & 1;
  }
  REQUIRE(counts == expected);
  REQUIRE(counts[2] == 0);
  REQUIRE(counts[4] > 0);
}

TEST_CASE("route of nothing is nothing", "[route]") {
  const TileGrid grid = make_tile_grid(1, 32, 32, 16, 0, -1);
  const RouteInput<float> in{nullptr, nullptr, nullptr, nullptr, 0, grid, {{0, 2}, {2, 4}, 2}};
  std::int64_t counts[4] = {7, 7, 7, 7};
  NoWorkspace workspace;
  cpu::route_count(in, nullptr, counts, workspace, nullptr);
  for (const std::int64_t count : counts) REQUIRE(count == 0);
}
