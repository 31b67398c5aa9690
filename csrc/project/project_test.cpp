// SPDX-License-Identifier: Apache-2.0
#include "project/project.h"

#include <algorithm>
#include <random>
#include <vector>

#include "common/catch.h"

using namespace blitzgs;

namespace {

// 2500 Gaussians (three blocks of candidates) around the origin, seen by three cameras on the z axis.
struct World {
  static constexpr int kCount = 2500, kViews = 3, kBasis = 4;
  std::vector<double> means, quats, scales, opacities, sh, viewmats, Ks;

  World() {
    std::mt19937 engine(5);
    std::normal_distribution<double> normal;
    const auto fill = [&](std::vector<double>* values, int size, double spread, double middle) {
      for (int i = 0; i < size; ++i) values->push_back(middle + spread * normal(engine));
    };
    fill(&means, 3 * kCount, 1.5, 0.0);
    fill(&quats, 4 * kCount, 1.0, 0.0);
    fill(&scales, 3 * kCount, 0.5, -2.0);
    fill(&opacities, kCount, 2.0, 0.0);
    fill(&sh, 3 * kBasis * kCount, 0.5, 0.0);
    for (int view = 0; view < kViews; ++view) {
      const double z = 2.0 + view;
      for (const double x :
           {1.0, 0.0, 0.0, 0.1 * view, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0}) {
        viewmats.push_back(x);
      }
      for (const double x : {40.0, 0.0, 20.0, 0.0, 42.0, 15.0, 0.0, 0.0, 1.0}) Ks.push_back(x);
    }
  }

  ProjectInputs<double> inputs() const {
    const ProjectOptions<double> options{40, 30, 16, 1, kBasis, 0.05, 1e10, 0.3, 0.0, true, true};
    return {means.data(), quats.data(), scales.data(), opacities.data(), sh.data(), viewmats.data(),
            Ks.data(),    nullptr,      nullptr,       kCount,           kViews,    options};
  }
};

struct Projected final : SplatMemory<double> {
  ProjectSizes sizes{};
  std::vector<std::int64_t> totals, rank_masks;
  std::vector<std::int32_t> gaussian_ids, camera_ids, visible_ids, splat_offsets, radii, tiles;
  std::vector<double> means2d, conics, depths, opacities, colors;

  const ProjectSizes* capacity() const override { return nullptr; }
  ProjectColumns<double> allocate(const ProjectSizes& counted) override {
    sizes = counted;
    const std::size_t U = sizes.visible, P = sizes.splats;
    for (auto* ints : {&gaussian_ids, &camera_ids, &tiles}) ints->resize(P);
    radii.resize(2 * P);
    visible_ids.resize(U);
    splat_offsets.resize(U + 1);
    means2d.resize(2 * P);
    conics.resize(3 * P);
    depths.resize(P);
    opacities.resize(P);
    colors.resize(3 * P);
    rank_masks.resize(P);
    return {{gaussian_ids.data(), camera_ids.data(), visible_ids.data(), splat_offsets.data()},
            {means2d.data(), conics.data(), depths.data(), opacities.data(), colors.data(), radii.data(),
             tiles.data(), rank_masks.data(), nullptr, nullptr}};
  }
};

Projected project(const ProjectInputs<double>& in, const RankTiles& ranks = {}) {
  Projected p;
  TestWorkspace workspace;
  p.totals.resize(project_totals(in.n_views, ranks.n_ranks));
  cpu::project(in, ranks, p, p.totals.data(), workspace, nullptr);
  return p;
}

// A scalar function of the splats, the weighted sum of all their differentiable values and the regularisers.
struct Weights {
  std::vector<double> means2d, conics, depths, opacities, colors;
  std::vector<double> scale_reg{0.3, 0.0, -0.2}, opacity_reg{-0.1, 0.4, 0.2};

  explicit Weights(std::int64_t splats) {
    std::mt19937 engine(6);
    std::normal_distribution<double> normal;
    for (auto* values : {&means2d, &conics, &depths, &opacities, &colors}) {
      const std::int64_t width = values == &means2d ? 2 : (values == &conics || values == &colors ? 3 : 1);
      for (std::int64_t i = 0; i < width * splats; ++i) values->push_back(normal(engine));
    }
  }

  double of(const Projected& p, const World& world) const {
    double sum = 0;
    const auto add = [&](const std::vector<double>& w, const std::vector<double>& values) {
      REQUIRE(w.size() == values.size());
      for (std::size_t i = 0; i < w.size(); ++i) sum += w[i] * values[i];
    };
    add(means2d, p.means2d);
    add(conics, p.conics);
    add(depths, p.depths);
    add(opacities, p.opacities);
    add(colors, p.colors);
    for (std::size_t splat = 0; splat < p.camera_ids.size(); ++splat) {
      const double* s = &world.scales[3 * p.gaussian_ids[splat]];
      sum += scale_reg[p.camera_ids[splat]] * std::exp(std::min({s[0], s[1], s[2]}));
      sum += opacity_reg[p.camera_ids[splat]] * sigmoid(world.opacities[p.gaussian_ids[splat]]);
    }
    return sum;
  }
};

}  // namespace

TEST_CASE("splats are ordered by Gaussian and view, and the totals count them") {
  const World world;
  const Projected p = project(world.inputs());
  REQUIRE(p.sizes.splats > 2000);
  REQUIRE(p.sizes.visible > 1000);
  REQUIRE(p.splat_offsets.front() == 0);
  REQUIRE(p.splat_offsets.back() == p.sizes.splats);
  std::int64_t tiles = 0;
  for (std::int64_t splat = 0; splat < p.sizes.splats; ++splat) {
    tiles += p.tiles[splat];
    if (splat == 0) continue;
    const std::int64_t before = p.gaussian_ids[splat - 1] * World::kViews + p.camera_ids[splat - 1];
    REQUIRE(before < p.gaussian_ids[splat] * World::kViews + p.camera_ids[splat]);
  }
  REQUIRE(tiles == p.totals[kTotalTiles]);
  for (int view = 0; view < World::kViews; ++view) {
    REQUIRE(p.totals[kTotalViews + view] == std::count(p.camera_ids.begin(), p.camera_ids.end(), view));
  }
  for (std::int64_t u = 0; u < p.sizes.visible; ++u) {
    for (int splat = p.splat_offsets[u]; splat < p.splat_offsets[u + 1]; ++splat) {
      REQUIRE(p.gaussian_ids[splat] == p.visible_ids[u]);
    }
  }
}

TEST_CASE("each splat knows the ranks that composite its tiles, and the totals count them") {
  const World world;
  // Views of 3 x 2 tiles. Rank 1 has none; ranks 0 and 2 overlap.
  const RankTiles ranks{{0, 4, 4, 10}, {7, 4, 12, 18}, 4};
  const Projected p = project(world.inputs(), ranks), alone = project(world.inputs());
  REQUIRE(p.conics == alone.conics);
  std::vector<std::int64_t> expected(8, 0);
  for (std::size_t splat = 0; splat < p.rank_masks.size(); ++splat) {
    std::int64_t mask = 0;
    for_each_tile_row(&p.means2d[2 * splat], &p.conics[3 * splat], p.opacities[splat], 40, 30, 16,
                      [&](int ty, int begin, int end) {
                        const int row = 6 * p.camera_ids[splat] + 3 * ty;
                        for (int tile = row + begin; tile < row + end; ++tile) {
                          for (int m = 0; m < 4; ++m) {
                            if (tile < ranks.begin[m] || tile >= ranks.end[m]) continue;
                            mask |= std::int64_t{1} << m;
                            ++expected[2 * m + 1];
                          }
                        }
                      });
    REQUIRE(p.rank_masks[splat] == mask);
    for (int m = 0; m < 4; ++m) expected[2 * m] += mask >> m & 1;
  }
  REQUIRE(std::equal(expected.begin(), expected.end(), p.totals.begin() + kTotalViews + World::kViews));
}

TEST_CASE("the backward pass is the derivative of the splats") {
  World world;
  const Projected p = project(world.inputs());
  const Weights weights(p.sizes.splats);
  const std::int64_t U = p.sizes.visible;
  std::vector<double> v_means(3 * U), v_quats(4 * U), v_scales(3 * U), v_opacities(U),
      v_sh(3 * World::kBasis * U), v_viewmats(16 * World::kViews);
  TestWorkspace workspace;
  cpu::project_bwd(
      world.inputs(), SplatIndex{p.camera_ids.data(), p.visible_ids.data(), p.splat_offsets.data(), U},
      SplatGradientColumns<double>{weights.means2d.data(), weights.conics.data(), weights.depths.data(),
                                   weights.opacities.data(), weights.colors.data()},
      Regularisers<double>{weights.scale_reg.data(), weights.opacity_reg.data()},
      ProjectGradients<double>{v_means.data(), v_quats.data(), v_scales.data(), v_opacities.data(),
                               v_sh.data(), v_viewmats.data()},
      workspace, nullptr);
  // A step of 1e-6 could move a splat across the edge of the image and so change the number of splats; the
  // difference quotient would then be meaningless, and the test fails.
  const auto slope = [&](double* value) {
    const double middle = *value, h = 1e-6;
    *value = middle + h;
    const Projected above = project(world.inputs());
    const double up = above.sizes.splats == p.sizes.splats ? weights.of(above, world) : 0;
    *value = middle - h;
    const Projected below = project(world.inputs());
    const double down = below.sizes.splats == p.sizes.splats ? weights.of(below, world) : 0;
    *value = middle;
    REQUIRE((above.sizes.splats == p.sizes.splats && below.sizes.splats == p.sizes.splats));
    return (up - down) / (2 * h);
  };
  for (const std::int64_t u : {std::int64_t{0}, U / 3, U - 1}) {
    const std::int64_t id = p.visible_ids[u];
    for (int i = 0; i < 3; ++i) {
      REQUIRE(slope(&world.means[3 * id + i]) == Approx(v_means[3 * u + i]).epsilon(1e-5).margin(1e-3));
      REQUIRE(slope(&world.scales[3 * id + i]) == Approx(v_scales[3 * u + i]).epsilon(1e-5).margin(1e-3));
      REQUIRE(slope(&world.quats[4 * id + i]) == Approx(v_quats[4 * u + i]).epsilon(1e-5).margin(1e-3));
    }
    REQUIRE(slope(&world.opacities[id]) == Approx(v_opacities[u]).epsilon(1e-5).margin(1e-3));
    for (int k = 0; k < 3 * World::kBasis; k += 5) {
      const std::int64_t stride = 3 * World::kBasis;
      REQUIRE(slope(&world.sh[stride * id + k]) == Approx(v_sh[stride * u + k]).epsilon(1e-5).margin(1e-3));
    }
  }
  for (const int i : {3, 5, 16 + 2, 32 + 8, 32 + 11}) {
    INFO("viewmats entry " << i);
    REQUIRE(slope(&world.viewmats[i]) == Approx(v_viewmats[i]).epsilon(1e-4));
  }
  REQUIRE(v_viewmats[15] == 0.0);
}

TEST_CASE("arrays are zeroed to their ends") {
  std::vector<float> values(20, 7.f);
  float* const v = values.data();
  cpu::zero_arrays(ZeroedArrays<float>{{v, v + 6, v + 8, nullptr, v + 12}, {5, 1, 3, 0, 7}}, nullptr);
  REQUIRE(values == std::vector<float>{0, 0, 0, 0, 0, 7, 0, 7, 0, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 7});
}
