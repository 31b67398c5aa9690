// SPDX-License-Identifier: Apache-2.0
// Fits Gaussians to an image by gradient descent, from C++ alone: renders three Gaussians, moves and
// recolours them, and finds their places and colours again. Prints the loss before and after, and writes the
// first gradient of the means, raw float32 [3, 3].
//
//   cmake -S examples/cpp -B build-cpp -DBLITZGS_TORCH_DIR=<site-packages>/torch
//   cmake --build build-cpp && ./build-cpp/fit gradient.f32
#include <torch/csrc/stable/device.h>
#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <cstdio>
#include <fstream>
#include <vector>

#include "api/blitzgs.h"

namespace {

namespace api = blitzgs::api;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// A view of numbers that live elsewhere.
Tensor tensor_of(std::vector<float>& values, const std::vector<std::int64_t>& shape) {
  std::vector<std::int64_t> strides(shape.size(), 1);
  for (std::size_t i = shape.size() - 1; i > 0; --i) strides[i - 1] = strides[i] * shape[i];
  return torch::stable::from_blob(values.data(), shape, strides, torch::stable::Device("cpu"),
                                  ScalarType::Float);
}

const float* floats(const Tensor& tensor) { return static_cast<const float*>(tensor.const_data_ptr()); }

void descend(std::vector<float>& values, const Tensor& gradient, float rate) {
  for (std::size_t i = 0; i < values.size(); ++i) values[i] -= rate * floats(gradient)[i];
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: %s GRADIENT.f32\n", argv[0]);
    return 2;
  }
  std::vector<float> means{-0.5f, 0, 3, 0.4f, 0.1f, 4, 0, -0.3f, 5};
  std::vector<float> quats{1, 0, 0, 0, 0.9f, 0.1f, 0.3f, 0.2f, 1, 0, 0, 0.5f};
  std::vector<float> scales{0.2f, 0.3f, 0.2f, 0.5f, 0.1f, 0.3f, 0.6f, 0.6f, 0.1f};
  std::vector<float> opacities{0.9f, 0.7f, 0.8f};
  std::vector<float> sh{1, -0.5f, -1, -1, 1, 0, 0.2f, 0, 1.5f};  // degree 0
  std::vector<float> viewmat{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  std::vector<float> K{100, 0, 64, 0, 100, 48, 0, 0, 1};
  // The tensors refer to the numbers above, so they follow them.
  const api::Gaussians gaussians{tensor_of(means, {3, 3}), tensor_of(quats, {3, 4}),
                                 tensor_of(scales, {3, 3}), tensor_of(opacities, {3}),
                                 tensor_of(sh, {3, 1, 3})};
  const api::Cameras cameras{tensor_of(viewmat, {1, 4, 4}), tensor_of(K, {1, 3, 3})};
  const api::TileGrid grid{.n_cameras = 1, .width = 128, .height = 96};
  const api::ProjectOptions options{.width = grid.width, .height = grid.height};

  auto splats = api::project(gaussians, cameras, options);
  auto lists = api::intersect(splats, grid);
  auto images = api::rasterize(splats, splats.colors, lists, grid);
  const std::vector<float> target(floats(images.renders), floats(images.renders) + images.renders.numel());

  for (float& mean : means) mean += 0.05f;
  for (float& coefficient : sh) coefficient *= 0.7f;
  double first = 0, loss = 0;
  for (int step = 0; step < 200; ++step) {
    splats = api::project(gaussians, cameras, options);
    lists = api::intersect(splats, grid);
    images = api::rasterize(splats, splats.colors, lists, grid);
    // The mean of squared differences, and its gradient.
    std::vector<float> v_renders(target.size());
    loss = 0;
    for (std::size_t i = 0; i < target.size(); ++i) {
      const float difference = floats(images.renders)[i] - target[i];
      loss += static_cast<double>(difference) * difference / target.size();
      v_renders[i] = 2 * difference / target.size();
    }
    const auto v_splats = api::rasterize_backward(splats, splats.colors, lists, grid, images,
                                                  tensor_of(v_renders, {1, 96, 128, 3}));
    const auto v = api::project_backward(gaussians, cameras, options, splats, v_splats,
                                         /*of_viewmats=*/false, /*of_all=*/true);
    if (step == 0) {
      first = loss;
      std::ofstream file(argv[1], std::ios::binary);
      file.write(static_cast<const char*>(v.means.const_data_ptr()), v.means.numel() * sizeof(float));
    }
    descend(means, v.means, 0.5f);
    descend(sh, v.sh, 20.f);
  }
  std::printf("loss %.3g before and %.3g after 200 steps\n", first, loss);
  return 0;
}
