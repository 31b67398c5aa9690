// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <vector>

#include "common/catch.h"
#include "importance/importance.h"
#include "importance/mass_cut.h"

using namespace blitzgs;

namespace {

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

}  // namespace

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

TEST_CASE("first digits grow with the number and fit their table") {
  int before = -1;
  for (std::int64_t number = 0; number < 100'000; ++number) {
    const int digit = first_digit(number);
    REQUIRE(digit >= before);
    before = digit;
  }
  for (int exponent = 17; exponent < 63; ++exponent) {
    const std::int64_t power = std::int64_t{1} << exponent;
    REQUIRE(first_digit(power - 1) < first_digit(power));
    REQUIRE(first_digit(power) > before);
    before = first_digit(power);
  }
  REQUIRE(first_digit(std::numeric_limits<std::int64_t>::max()) == 1008);
  REQUIRE(1008 < kFirstDigits);
}

TEST_CASE("a first digit leaves its numbers' leading bits and what is behind them") {
  for (const std::int64_t number : {std::int64_t{1}, std::int64_t{9}, std::int64_t{31}, std::int64_t{1} << 40,
                                    std::numeric_limits<std::int64_t>::max()}) {
    MassSearch search{kAboveAllWeights, 0, 10, 0};
    take_digit(search, true, first_digit(number), 3, 8);
    REQUIRE(search.head == number >> search.shift);
    REQUIRE(search.shift <= (kRounds - 1) * kDigitBits);
    REQUIRE(search.missing == 7);
    REQUIRE(search.held == 8);
  }
}

TEST_CASE("the share of a total is rounded up and does not overflow") {
  REQUIRE(share_of(100, 99, 100) == 99);
  REQUIRE(share_of(101, 99, 100) == 100);
  REQUIRE(share_of(1, 1, 1'000'000'000) == 1);
  REQUIRE(share_of(7, 0, 1) == 0);
  REQUIRE(share_of((std::int64_t{1} << 61) + 1, 999'999'999, 1'000'000'000) == 2'305'843'006'907'850'944);
}

TEST_CASE("a cut takes the heaviest and, of equal ones, those of the smallest ids") {
  const std::vector<std::int64_t> weights{5, 1, 5, 0, 5, 80}, ids{30, 11, 10, 12, 20, 99};
  const std::vector<std::int32_t> segments(6, 0), owners{0, 1, 2, 3, 4, 5};
  SegmentSearch search{};
  std::vector<std::int64_t> sums(kDigits, 0);
  std::vector<std::int32_t> listed(7);
  bool chosen[6];
  // 90 of 96: the heaviest, and two of the three that weigh 5.
  const MassCutArgs args{weights.data(), segments.data(), owners.data(), ids.data(), 6, 1, 90, 96,
                         &search,        sums.data(),     listed.data(), chosen};
  cpu::mass_cut(args, 0, kSteps, nullptr);
  const std::vector<bool> found(chosen, chosen + 6);
  REQUIRE(found == std::vector<bool>{false, false, true, false, true, true});
}
