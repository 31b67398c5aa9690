// SPDX-License-Identifier: Apache-2.0
#include "common/catch.h"
#include "exchange/scatter.h"
#include "exchange/tile_costs.h"

using namespace blitzgs;

namespace {

SplatGroups make_groups(const std::vector<int64_t>& sizes) {
  SplatGroups groups{};
  for (const int64_t size : sizes) {
    const int m = groups.count++;
    groups.size[m] = size;
    groups.start[m] = m ? groups.start[m - 1] + groups.size[m - 1] : 0;
  }
  return groups;
}

}  // namespace

TEST_CASE("scattered splats arrive in order, and their sums return", "[scatter]") {
  const int n = 9000, n_ranks = 3;  // more than one chunk
  std::vector<int32_t> a(2 * n), b(n);
  std::vector<int64_t> masks(n), sizes(n_ranks);
  for (int i = 0; i < n; ++i) {
    a[2 * i] = i, a[2 * i + 1] = -i, b[i] = 7 * i;
    masks[i] = (i % 2 ? 1 : 0) | (i % 5 ? 0 : 4);  // rank 1 gets nothing, some splats go nowhere
    for (int m = 0; m < n_ranks; ++m) sizes[m] += (masks[i] >> m) & 1;
  }
  const SplatGroups groups = make_groups(sizes);
  const int64_t total = groups.start[2] + groups.size[2];
  std::vector<int32_t> packed(3 * total);
  std::vector<SplatPlace> places(place_runs(n) * n_ranks);
  ScatterTargets targets{};
  for (int m = 0; m < n_ranks; ++m) {
    targets.words[m][0] = packed.data() + 3 * groups.start[m];
    targets.words[m][1] = targets.words[m][0] + 2 * groups.size[m];
  }
  TestWorkspace workspace;
  cpu::scatter({{{a.data(), b.data()}, {0, 2, 3}, 2}, masks.data(), n}, groups, targets, places.data(),
               workspace, nullptr);

  std::vector<int32_t> a2(2 * total), b2(total);
  cpu::gather(packed.data(), groups, {{a2.data(), b2.data()}, {0, 2, 3}, 2}, nullptr);
  size_t at = 0;
  for (int m = 0; m < n_ranks; ++m) {
    for (int i = 0; i < n; ++i) {
      if (((masks[i] >> m) & 1) == 0) continue;
      REQUIRE((a2[2 * at] == i && a2[2 * at + 1] == -i && b2[at] == 7 * i));
      ++at;
    }
  }
  REQUIRE(at == b2.size());

  std::vector<double> values(3 * total), x(n, -1.0), y(2 * n, -1.0);
  for (int64_t i = 0; i < total; ++i) {
    const double weight = i < groups.start[2] ? 1.0 : 10.0;
    values[3 * i] = weight * b2[i];
    values[3 * i + 1] = weight;
    values[3 * i + 2] = 2 * weight;
  }
  SplatValues<double> back{{}, {}, n_ranks, 3, n, places.data()};
  for (int m = 0; m < n_ranks; ++m) {
    back.values[m] = values.data() + 3 * groups.start[m];
    back.size[m] = groups.size[m];
  }
  cpu::sum<double>(back, {{x.data(), y.data()}, {0, 1, 3}, 2}, nullptr);
  for (int i = 0; i < n; ++i) {
    const double weight = (masks[i] & 1 ? 1.0 : 0.0) + (masks[i] & 4 ? 10.0 : 0.0);
    REQUIRE(x[i] == weight * b[i]);
    REQUIRE((y[2 * i] == weight && y[2 * i + 1] == 2 * weight));
  }
}

TEST_CASE("splats beyond a group's size are dropped", "[scatter]") {
  const int32_t column[4] = {1, 2, 3, 4};
  const int64_t masks[4] = {1, 1, 1, 1};
  int32_t packed[4] = {-1, -1, -1, -1};
  SplatPlace place;
  ScatterTargets targets{};
  targets.words[0][0] = packed;
  TestWorkspace workspace;
  cpu::scatter({{{column}, {0, 1}, 1}, masks, 4}, make_groups({2}), targets, &place, workspace, nullptr);
  REQUIRE((packed[0] == 1 && packed[1] == 2 && packed[2] == -1));
  REQUIRE((place.first == 0 && place.bits == 15));
}

TEST_CASE("pieces spread over their tiles", "[tile_costs]") {
  // Two views of five tiles in pieces of two: costs 8 + 8 twice, 8 + 0 twice and 8 + 1016 once. A view
  // without costs of its own has those of the similar view.
  const uint16_t coarse[] = {0x4800, 0, 0x63f0}, fine[] = {0x4800, 0x4800, 0, 0, 0x63f0};
  const uint16_t *pieces[] = {coarse, coarse}, *guessed[] = {nullptr, coarse}, *tiles[] = {fine, fine};
  TestWorkspace workspace;
  for (int64_t parts = 1; parts < 12; ++parts) {
    std::vector<int64_t> a(parts + 1), b(parts + 1), c(parts + 1);
    cpu::divide_tiles({pieces, 2, nullptr, 0, 5, 2, 8}, parts, workspace, a.data());
    cpu::divide_tiles({guessed, 2, pieces, 1, 5, 2, 8}, parts, workspace, b.data());
    cpu::divide_tiles({tiles, 2, nullptr, 0, 5, 1, 8}, parts, workspace, c.data());
    REQUIRE((a == c && b == c));
  }
}
