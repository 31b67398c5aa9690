// SPDX-License-Identifier: Apache-2.0
#include "importance/importance.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/catch.h"
#include "common/test_workspace.h"

namespace {

using namespace blitzgs;

// Two round splats on an image of 20 x 12, in one list per tile of 16 x 16, the nearer one first.
template <class T>
struct Pair {
  std::vector<T> means2d{T(9.5), T(6.5), T(12), T(6)}, conics{T(0.1), T(0), T(0.1), T(0.05), T(0), T(0.05)};
  std::vector<T> opacities{T(0.999), T(0.7)};
  std::vector<std::int32_t> splats{0, 1, 0, 1};
  std::vector<std::int64_t> offsets{0, 2, 4}, weights{7, 7}, squares{7, 7};
  std::vector<std::int32_t> pixels{7, 7};
  TestWorkspace workspace;

  void survey(std::int64_t tile_begin, std::int64_t tile_end, bool with_squares = true) {
    const TileGrid grid = make_tile_grid(1, 20, 12, 16, tile_begin, tile_end);
    cpu::contributions<T>(
        {means2d.data(), conics.data(), opacities.data(), splats.data(), offsets.data(), 2, grid},
        {weights.data(), pixels.data(), with_squares ? squares.data() : nullptr}, workspace, nullptr);
  }
};

double alpha_at(const Pair<double>& pair, int splat, double x, double y) {
  const double dx = x - pair.means2d[2 * splat], dy = y - pair.means2d[2 * splat + 1];
  const double alpha =
      std::min(0.99, pair.opacities[splat] * std::exp(-0.5 * pair.conics[3 * splat] * (dx * dx + dy * dy)));
  return alpha >= 1.0 / 255.0 ? alpha : 0.0;
}

}  // namespace

TEST_CASE("contributions are alpha T, summed over pixels in units of 2^-32") {
  Pair<double> pair;
  pair.survey(0, -1);
  std::int64_t weights[2] = {0, 0};
  std::int32_t pixels[2] = {0, 0};
  for (int y = 0; y < 12; ++y) {
    for (int x = 0; x < 20; ++x) {
      const double near = alpha_at(pair, 0, x + 0.5, y + 0.5), far = alpha_at(pair, 1, x + 0.5, y + 0.5);
      weights[0] += std::llrint(near * 4294967296.0);
      weights[1] += std::llrint(far * (1 - near) * 4294967296.0);
      pixels[0] += near > 0;
      pixels[1] += far > 0;
    }
  }
  for (int splat = 0; splat < 2; ++splat) {
    REQUIRE(pair.pixels[splat] == pixels[splat]);
    // The exponential may differ by rounding, which changes the weight of a pixel by at most one unit.
    REQUIRE(std::abs(pair.weights[splat] - weights[splat]) <= pixels[splat]);
  }
}

TEST_CASE("squares are rounded down for each pixel") {
  Pair<double> pair;
  pair.survey(0, -1);
  std::int64_t squares = 0;
  std::int32_t pixels = 0;
  for (int y = 0; y < 12; ++y) {
    for (int x = 0; x < 20; ++x) {
      const double alpha = alpha_at(pair, 0, x + 0.5, y + 0.5);
      squares += static_cast<std::int64_t>(std::floor(alpha * alpha * 4294967296.0));
      pixels += alpha > 0;
    }
  }
  REQUIRE(pair.pixels[0] == pixels);
  // A weight that is one unit off changes its square by at most two.
  REQUIRE(std::abs(pair.squares[0] - squares) <= 2 * pixels);
}

TEST_CASE("squares are optional and change no other sum") {
  Pair<float> with, without;
  with.survey(0, -1);
  without.survey(0, -1, false);
  REQUIRE(without.weights == with.weights);
  REQUIRE(without.pixels == with.pixels);
  REQUIRE(without.squares == std::vector<std::int64_t>{7, 7});
}

TEST_CASE("contributions of tile ranges add up") {
  Pair<float> pair;
  pair.survey(0, -1);
  const std::vector<std::int64_t> weights = pair.weights, squares = pair.squares;
  const std::vector<std::int32_t> pixels = pair.pixels;
  pair.survey(0, 1);
  const std::vector<std::int64_t> left_weights = pair.weights, left_squares = pair.squares;
  const std::vector<std::int32_t> left_pixels = pair.pixels;
  pair.survey(1, 2);
  for (int splat = 0; splat < 2; ++splat) {
    REQUIRE(left_weights[splat] + pair.weights[splat] == weights[splat]);
    REQUIRE(left_squares[splat] + pair.squares[splat] == squares[splat]);
    REQUIRE(left_pixels[splat] + pair.pixels[splat] == pixels[splat]);
    REQUIRE(left_pixels[splat] > 0);
    REQUIRE(pair.pixels[splat] > 0);
  }
  pair.survey(1, 1);
  REQUIRE(pair.weights == std::vector<std::int64_t>{0, 0});
  REQUIRE(pair.squares == std::vector<std::int64_t>{0, 0});
}
