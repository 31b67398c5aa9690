// SPDX-License-Identifier: Apache-2.0
// Calls the ops of BlitzGS from C++, without Python, through the stable ABI of LibTorch: project, intersect
// and rasterize three Gaussians, and write the image as raw float32 [96, 128, 3].
//
//   cmake -S examples/cpp -B build-cpp -DBLITZGS_TORCH_DIR=<site-packages>/torch
//   cmake --build build-cpp && ./build-cpp/render image.f32
//
// Linking libblitzgs_cpu.so registers the ops; csrc/api/blitzgs.h has structs for their arguments and
// results. On a GPU it is libblitzgs_cuda.so, and the tensors live there.
#include <torch/csrc/stable/device.h>
#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <cstdio>
#include <fstream>
#include <vector>

#include "api/blitzgs.h"

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// A view of numbers that live elsewhere.
Tensor tensor_of(std::vector<float>& values, const std::vector<std::int64_t>& shape) {
  std::vector<std::int64_t> strides(shape.size(), 1);
  for (std::size_t i = shape.size() - 1; i > 0; --i) strides[i - 1] = strides[i] * shape[i];
  return torch::stable::from_blob(values.data(), shape, strides, torch::stable::Device("cpu"),
                                  ScalarType::Float);
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) {
    std::fprintf(stderr, "usage: %s IMAGE.f32\n", argv[0]);
    return 2;
  }
  std::vector<float> means{-0.5f, 0, 3, 0.4f, 0.1f, 4, 0, -0.3f, 5};
  std::vector<float> quats{1, 0, 0, 0, 0.9f, 0.1f, 0.3f, 0.2f, 1, 0, 0, 0.5f};
  std::vector<float> scales{0.2f, 0.3f, 0.2f, 0.5f, 0.1f, 0.3f, 0.6f, 0.6f, 0.1f};
  std::vector<float> opacities{0.9f, 0.7f, 0.8f};
  std::vector<float> sh{1, -0.5f, -1, -1, 1, 0, 0.2f, 0, 1.5f};  // degree 0
  std::vector<float> viewmat{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  std::vector<float> K{100, 0, 64, 0, 100, 48, 0, 0, 1};

  const blitzgs::api::Gaussians gaussians{
      .means = tensor_of(means, {3, 3}),
      .quats = tensor_of(quats, {3, 4}),
      .scales = tensor_of(scales, {3, 3}),
      .opacities = tensor_of(opacities, {3}),
      .sh = tensor_of(sh, {3, 1, 3}),
  };
  const blitzgs::api::Cameras cameras{.viewmats = tensor_of(viewmat, {1, 4, 4}),
                                      .Ks = tensor_of(K, {1, 3, 3})};
  const blitzgs::api::TileGrid grid{.n_cameras = 1, .width = 128, .height = 96};
  const auto splats = blitzgs::api::project(gaussians, cameras, {.width = grid.width, .height = grid.height});
  const auto lists = blitzgs::api::intersect(splats, grid);
  const Tensor image = blitzgs::api::rasterize(splats, splats.colors, lists, grid).renders;

  std::ofstream file(argv[1], std::ios::binary);
  file.write(static_cast<const char*>(image.const_data_ptr()), image.numel() * sizeof(float));
  file.close();
  if (!file) {
    std::fprintf(stderr, "%s cannot be written\n", argv[1]);
    return 1;
  }
  std::printf("%lld of 3 Gaussians visible\n", static_cast<long long>(splats.visible_ids.size(0)));
  return 0;
}
