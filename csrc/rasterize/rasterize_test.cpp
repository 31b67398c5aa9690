// SPDX-License-Identifier: Apache-2.0
#include "rasterize/rasterize.h"

#include <algorithm>
#include <numeric>

#include "common/catch.h"
#include "importance/importance.h"
#include "intersect/intersect.h"

namespace {

using namespace blitzgs;

// Two splats on a 40 x 20 image: splat 0 is wide and far, splat 1 is round and near.
template <class T> struct Scene {
  TileGrid grid = make_tile_grid(1, 40, 20, 16, 0, -1);
  std::vector<T> means2d{T(20.5), T(10.5), T(12), T(8)};
  std::vector<T> conics{T(0.02), T(0.005), T(0.03), T(0.25), T(0), T(0.25)};
  std::vector<T> opacities{T(0.8), T(0.5)}, depths{T(2), T(1)}, colors{T(1), T(0.5), T(0), T(0), T(0), T(1)};
  std::vector<int32_t> cameras{0, 0}, splats;
  std::vector<int64_t> offsets = std::vector<int64_t>(7);
  std::vector<T> renders = std::vector<T>(2400), rest = std::vector<T>(800);
  std::vector<int32_t> last = std::vector<int32_t>(800), work = std::vector<int32_t>(6);
  TestWorkspace workspace;

  void intersect_splats() {
    const IntersectInput<T> in{
        means2d.data(), conics.data(), opacities.data(), depths.data(), cameras.data(), nullptr, 2, grid};
    splats.resize(cpu::count_intersections(in, workspace, nullptr));
    REQUIRE(cpu::intersect(in, splats.size(), splats.data(), offsets.data(), workspace, nullptr) ==
            int64_t(splats.size()));
  }

  RasterizeInput<T> input() const {
    return {means2d.data(),
            conics.data(),
            opacities.data(),
            colors.data(),
            nullptr,
            splats.data(),
            offsets.data(),
            2,
            3,
            grid};
  }

  void render() {
    cpu::rasterize_fwd(input(), {renders.data(), rest.data(), last.data(), work.data(), nullptr, true}, {},
                       workspace, nullptr);
  }
};

}  // namespace

TEST_CASE("rasterization backward writes every gradient") {
  Scene<double> scene;
  scene.intersect_splats();
  scene.render();
  const std::vector<double> ones(2400, 1.0);
  std::vector<double> v_means(4, NAN), v_conics(6, NAN), v_opacities(2, NAN), v_colors(6, NAN), v_abs(4);
  cpu::rasterize_bwd<double>(
      scene.input(), {scene.rest.data(), scene.last.data(), ones.data(), nullptr},
      int64_t(scene.splats.size()), {}, true,
      {v_means.data(), v_conics.data(), v_opacities.data(), v_colors.data(), v_abs.data()}, scene.workspace,
      nullptr);
  for (const auto* values : {&v_conics, &v_opacities, &v_colors}) {
    for (const double v : *values) REQUIRE(std::isfinite(v));
  }
  for (int i = 0; i < 4; ++i) REQUIRE(v_abs[i] >= std::fabs(v_means[i]));
}

TEST_CASE("each pixel's splats and each splat's pixels are the same pairs") {
  Scene<float> scene;
  scene.intersect_splats();
  std::vector<int64_t> weights(2), squares(2);
  std::vector<int32_t> pixels(2), counts(800), medians(800), ids(800);
  std::vector<float> strongest(800);
  cpu::contributions(scene.input(), {weights.data(), pixels.data(), squares.data()}, scene.workspace,
                     nullptr);
  cpu::pixel_splats(scene.input(),
                    PixelSplats<float>{nullptr, 800, 1, scene.rest.data(), counts.data(), medians.data(),
                                       ids.data(), strongest.data()},
                    scene.workspace, nullptr);
  REQUIRE(std::accumulate(counts.begin(), counts.end(), 0) == pixels[0] + pixels[1]);
  REQUIRE(std::count(ids.begin(), ids.end(), -1) == std::count(counts.begin(), counts.end(), 0));
  REQUIRE((pixels[0] > pixels[1] && pixels[1] > 0 && weights[1] > squares[1]));
}
