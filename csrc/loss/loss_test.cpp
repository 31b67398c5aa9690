// SPDX-License-Identifier: Apache-2.0
#include "common/catch.h"
#include "loss/photometric.h"

using namespace blitzgs;

namespace {

// Sums over one image of every pixel's |x - y| and SSIM, and the gradient of the weighted sums.
struct Run {
  std::vector<float> x, y, gradient;
  double l1 = 0, ssim = 0;
};

Run run(int width, int height, float l1_weight, float ssim_weight) {
  Run r;
  for (int i = 0; i < 3 * width * height; ++i) {
    r.x.push_back(0.5f + 0.4f * std::sin(0.9f * float(i)));
    r.y.push_back(0.5f + 0.4f * std::sin(0.9f * float(i) + 0.3f));
  }
  r.gradient.assign(r.x.size(), NAN);
  PhotometricArgs<float> args{};
  args.renders = r.x.data();
  args.targets = r.y.data();
  args.l1_weights = &l1_weight;
  args.ssim_weights = &ssim_weight;
  args.v_renders = r.gradient.data();
  args.views = 1;
  args.width = width;
  args.height = height;
  args.tile_size = 16;
  args.tiles_x = (width + 15) / 16;
  args.tiles_y = (height + 15) / 16;
  args.tile_end = args.tiles_x * args.tiles_y;
  double total = 0;
  for (int k = 0; k < kSsimTaps; ++k) total += std::exp(-(k - 5) * (k - 5) / 4.5);
  for (int k = 0; k < kSsimTaps; ++k) args.window[k] = float(std::exp(-(k - 5) * (k - 5) / 4.5) / total);
  std::vector<double> parts(2 * size_t(cpu::photometric_parts(args)));
  args.parts = parts.data();
  TestWorkspace workspace;
  cpu::photometric(args, workspace, nullptr);
  for (size_t i = 0; i < parts.size(); i += 2) r.l1 += parts[i], r.ssim += parts[i + 1];
  return r;
}

}  // namespace

TEST_CASE("every pixel has a gradient and is summed, in images smaller and larger than a strip") {
  for (const int height : {3, 70}) {
    const Run exact = run(9, height, 0.5f, 1.0f);
    for (const float v : exact.gradient) REQUIRE(std::isfinite(v));
    REQUIRE(std::isfinite(exact.ssim));
    double l1 = 0;
    for (size_t i = 0; i < exact.x.size(); ++i) l1 += std::fabs(exact.x[i] - exact.y[i]);
    REQUIRE(exact.l1 == Approx(l1).epsilon(1e-6));
  }
}
