// SPDX-License-Identifier: Apache-2.0
#include "project/project.h"

#include <numeric>
#include <random>

#include "common/catch.h"

using namespace blitzgs;

namespace {

// 2500 Gaussians (three blocks of candidates) around the origin, seen by three cameras on the z axis.
struct World {
  static constexpr int kCount = 2500, kViews = 3, kBasis = 16;
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
    const ProjectOptions<double> options{40, 30, 16, 3, kBasis, 0.05, 1e10, 0.3, 0.0, true, true};
    return {means.data(), quats.data(), scales.data(), opacities.data(), sh.data(), viewmats.data(),
            Ks.data(),    nullptr,      nullptr,       kCount,           kViews,    options};
  }
};

struct Projected {
  ProjectSizes sizes{};
  std::vector<int64_t> totals, rank_masks;
  std::vector<int32_t> gaussian_ids, camera_ids, visible_ids, splat_offsets, radii, tiles;
  std::vector<double> means2d, conics, depths, opacities, colors;

  ProjectColumns<double> allocate(const ProjectSizes& counted) {
    sizes = counted;
    const size_t U = sizes.visible, P = sizes.splats;
    const auto sized = [](auto& values, size_t size) {
      values.resize(size);
      return values.data();
    };
    return {
        {sized(gaussian_ids, P), sized(camera_ids, P), sized(visible_ids, U), sized(splat_offsets, U + 1)},
        {sized(means2d, 2 * P), sized(conics, 3 * P), sized(depths, P), sized(opacities, P),
         sized(colors, 3 * P), sized(radii, 2 * P), sized(tiles, P), sized(rank_masks, P), nullptr, nullptr}};
  }
};

Projected project(const ProjectInputs<double>& in, const RankTiles& ranks = {}) {
  Projected p;
  TestWorkspace workspace;
  p.totals.resize(project_totals(in.n_views, ranks.n_ranks));
  cpu::project<double>(
      in, ranks, nullptr, [&](const ProjectSizes& sizes) { return p.allocate(sizes); }, p.totals.data(),
      workspace, nullptr);
  return p;
}

}  // namespace

TEST_CASE("projection backward writes every gradient") {
  const World world;
  const Projected p = project(world.inputs());
  const size_t P = p.sizes.splats, U = p.sizes.visible;
  REQUIRE((U > 1000 && P > U));
  const std::vector<double> ones(3 * P, 1.0), zeros(3 * P, 0.0);
  std::vector<double> v_means(3 * U, NAN), v_quats(4 * U, NAN), v_scales(3 * U, NAN), v_opacities(U, NAN),
      v_sh(3 * World::kBasis * U, NAN), v_viewmats(16 * World::kViews, NAN);
  TestWorkspace workspace;
  cpu::project_bwd(
      world.inputs(),
      SplatIndex{p.camera_ids.data(), p.visible_ids.data(), p.splat_offsets.data(), p.sizes.visible},
      SplatGradientColumns<double>{ones.data(), zeros.data(), ones.data(), ones.data(), ones.data()},
      Regularisers<double>{nullptr, nullptr},
      ProjectGradients<double>{v_means.data(), v_quats.data(), v_scales.data(), v_opacities.data(),
                               v_sh.data(), v_viewmats.data()},
      workspace, nullptr);
  for (const auto* values : {&v_means, &v_quats, &v_scales, &v_opacities, &v_sh, &v_viewmats}) {
    REQUIRE(std::isfinite(std::accumulate(values->begin(), values->end(), 0.0)));
  }
}

TEST_CASE("arrays are zeroed to their ends") {
  std::vector<float> values(9, 7.f);
  float* const v = values.data();
  cpu::zero_arrays(ZeroedArrays<float>{{v, v + 3, v + 4, nullptr, v + 6}, {2, 1, 1, 0, 2}}, nullptr);
  REQUIRE(values == std::vector<float>{0, 0, 7, 0, 0, 7, 0, 0, 7});
}
