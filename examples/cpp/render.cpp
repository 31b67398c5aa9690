// SPDX-License-Identifier: Apache-2.0
// Calls the ops of BlitzGS from C++, without Python, through the stable ABI of LibTorch: project, intersect
// and rasterize three Gaussians, and write the image as raw float32 [96, 128, 3].
//
//   cmake -S examples/cpp -B build-cpp -DBLITZGS_TORCH_DIR=<site-packages>/torch
//   cmake --build build-cpp && ./build-cpp/render image.f32
//
// Linking libblitzgs_cpu.so registers the ops (csrc/registration.cpp lists them, with the groups of their
// arguments). On a GPU it is libblitzgs_cuda.so, and the tensors live there.
#include <torch/csrc/stable/device.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <optional>
#include <vector>

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;
namespace abi = torch::stable::detail;

constexpr std::int64_t kWidth = 128, kHeight = 96, kTileSize = 16, kViews = 1;

// Calls an op that returns so many tensors.
template <std::size_t Results, class... Arguments>
std::array<Tensor, Results> call(const char* op, const Arguments&... arguments) {
  std::array<StableIValue, std::max(sizeof...(Arguments), Results)> stack{abi::from(arguments)...};
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher(op, "", stack.data(), TORCH_ABI_VERSION));
  std::array<Tensor, Results> results;
  for (std::size_t i = 0; i < Results; ++i) results[i] = abi::to<Tensor>(stack[i]);
  return results;
}

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

  const std::vector<Tensor> gaussians{tensor_of(means, {3, 3}), tensor_of(quats, {3, 4}),
                                      tensor_of(scales, {3, 3}), tensor_of(opacities, {3}),
                                      tensor_of(sh, {3, 1, 3})};
  const std::vector<Tensor> cameras{tensor_of(viewmat, {1, 4, 4}), tensor_of(K, {1, 3, 3})};
  const std::vector<std::int64_t> ints{kWidth,   kHeight, kTileSize, /*sh_degree=*/0, /*antialiased=*/0,
                                       /*raw=*/0};
  const std::vector<double> floats{/*near=*/0.01, /*far=*/1e10, /*eps2d=*/0.3, /*radius_clip=*/0.0};
  const std::vector<Tensor> everywhere;  // no list of active Gaussians: all of them
  const std::vector<std::int64_t> no_ranks, no_capacity;
  const auto rows = call<14>("blitzgs::project_fwd", gaussians, cameras, everywhere, ints, floats, no_ranks,
                             no_capacity, std::nullopt, std::nullopt);
  const Tensor &camera_ids = rows[1], &visible_ids = rows[2], &means2d = rows[4], &conics = rows[5],
               &depths = rows[6], &alphas = rows[7], &colors = rows[8];

  constexpr std::int64_t kFirstTile = 0, kAllTiles = -1, kCountThem = -1;
  const std::vector<std::int64_t> grid{kViews, kWidth, kHeight, kTileSize, kFirstTile, kAllTiles};
  const auto lists = call<2>("blitzgs::intersect", means2d, conics, alphas, depths, camera_ids, std::nullopt,
                             grid, kCountThem, std::nullopt, /*unchecked=*/false);
  const auto images =
      call<7>("blitzgs::rasterize_fwd", means2d, conics, alphas, colors, std::nullopt, lists[0], lists[1],
              grid, /*clear_rest=*/true, /*backward_follows=*/false, std::nullopt);

  const Tensor& image = images[0];
  std::ofstream file(argv[1], std::ios::binary);
  file.write(static_cast<const char*>(image.const_data_ptr()), image.numel() * sizeof(float));
  file.close();
  if (!file) {
    std::fprintf(stderr, "%s cannot be written\n", argv[1]);
    return 1;
  }
  std::printf("%lld of 3 Gaussians visible\n", static_cast<long long>(visible_ids.size(0)));
  return 0;
}
