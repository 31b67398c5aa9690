// SPDX-License-Identifier: Apache-2.0
#include "photometric/photometric.h"

#include <cmath>
#include <tuple>

#include "common/op.h"

namespace blitzgs {
namespace {

template <class T>
void fill_window(T (&window)[kSsimTaps]) {
  double values[kSsimTaps], total = 0;
  for (int i = 0; i < kSsimTaps; ++i) {
    values[i] = std::exp(-(i - kSsimRadius) * (i - kSsimRadius) / (2 * 1.5 * 1.5));
    total += values[i];
  }
  for (int i = 0; i < kSsimTaps; ++i) window[i] = static_cast<T>(values[i] / total);
}

struct PhotometricOutputs {
  std::optional<Tensor> l1_sums, ssim_sums, v_renders;
};

void check_weights(const char* op, const char* name, const Tensor& weights, const Tensor& renders) {
  check_dtype(op, name, weights, renders.scalar_type());
  check_shape(op, name, weights, {renders.size(0)});
}

PhotometricOutputs run_photometric(const char* op, const Tensor& renders_in, const Tensor& targets_in,
                                   const std::optional<Tensor>& masks_in, const Tensor* l1_weights_in,
                                   const Tensor* ssim_weights_in, bool sums, std::int64_t tile_size,
                                   std::int64_t tile_begin, std::int64_t tile_end) {
  check_floating(op, "renders", renders_in);
  check_shape(op, "renders", renders_in, {-1, -1, -1, 3});
  const std::int64_t views = renders_in.size(0), height = renders_in.size(1), width = renders_in.size(2);
  check_shape(op, "targets", targets_in, {views, height, width, 3});
  const bool bytes = targets_in.scalar_type() == ScalarType::Byte;
  if (!bytes) check_dtype(op, "targets (if not uint8)", targets_in, renders_in.scalar_type());
  STD_TORCH_CHECK(tile_size > 0 && tile_size <= 4096, "blitzgs::", op,
                  ": tile_size must be in [1, 4096], got ", tile_size);
  STD_TORCH_CHECK(height < (1 << 24) && width < (1 << 24), "blitzgs::", op, ": images of ", width, " x ",
                  height, " pixels are beyond the limit of 2^24 a side");
  const Tensor renders = as_contiguous(renders_in), targets = as_contiguous(targets_in);
  std::optional<Tensor> masks;
  if (masks_in) {
    check_dtype(op, "masks", *masks_in, ScalarType::Byte);
    check_shape(op, "masks", *masks_in, {views, height, width});
    masks = as_contiguous(*masks_in);
  }
  std::optional<Tensor> l1_weights, ssim_weights;
  PhotometricOutputs outputs;
  if (l1_weights_in) {
    check_weights(op, "l1_weights", *l1_weights_in, renders);
    check_weights(op, "ssim_weights", *ssim_weights_in, renders);
    l1_weights = as_contiguous(*l1_weights_in);
    ssim_weights = as_contiguous(*ssim_weights_in);
    outputs.v_renders = make_empty(renders, {views, height, width, 3});
  }
  if (sums) {
    outputs.l1_sums = make_empty(renders, {views});
    outputs.ssim_sums = make_empty(renders, {views});
  }
  if (renders.numel() == 0) {
    if (sums) torch::stable::zero_(*outputs.l1_sums), torch::stable::zero_(*outputs.ssim_sums);
    return outputs;
  }

  DeviceScope scope(renders);
  dispatch_floating(renders, [&](auto zero) {
    using T = decltype(zero);
    PhotometricArgs<T> args{};
    args.renders = data<T>(renders);
    args.targets = bytes ? nullptr : data<T>(targets);
    args.targets_u8 = bytes ? data<std::uint8_t>(targets) : nullptr;
    args.masks = data_or_null<std::uint8_t>(masks);
    args.l1_weights = data_or_null<T>(l1_weights);
    args.ssim_weights = data_or_null<T>(ssim_weights);
    args.l1_sums = sums ? mutable_data<T>(*outputs.l1_sums) : nullptr;
    args.ssim_sums = sums ? mutable_data<T>(*outputs.ssim_sums) : nullptr;
    args.v_renders = outputs.v_renders ? mutable_data<T>(*outputs.v_renders) : nullptr;
    args.clear_rest = !sums;
    args.views = views;
    args.width = static_cast<int>(width);
    args.height = static_cast<int>(height);
    args.tile_size = static_cast<int>(tile_size);
    args.tiles_x = static_cast<int>((width + tile_size - 1) / tile_size);
    args.tiles_y = static_cast<int>((height + tile_size - 1) / tile_size);
    args.tile_begin = tile_begin;
    const std::int64_t tiles = views * args.tiles_x * args.tiles_y;
    args.tile_end = tile_end < 0 ? tiles : tile_end;
    STD_TORCH_CHECK(0 <= tile_begin && tile_begin <= args.tile_end && args.tile_end <= tiles, "blitzgs::", op,
                    ": tile_begin and tile_end must be a range of the ", tiles, " tiles, got [", tile_begin,
                    ", ", tile_end, ")");
    fill_window(args.window);
    backend::photometric(args, scope.workspace, scope.stream);
  });
  return outputs;
}

std::tuple<Tensor, Tensor> photometric_fwd(const Tensor& renders, const Tensor& targets,
                                           const std::optional<Tensor>& masks, std::int64_t tile_size,
                                           std::int64_t tile_begin, std::int64_t tile_end) {
  PhotometricOutputs out = run_photometric("photometric_fwd", renders, targets, masks, nullptr, nullptr, true,
                                           tile_size, tile_begin, tile_end);
  return {*out.l1_sums, *out.ssim_sums};
}

Tensor photometric_bwd(const Tensor& renders, const Tensor& targets, const std::optional<Tensor>& masks,
                       const Tensor& l1_weights, const Tensor& ssim_weights, std::int64_t tile_size,
                       std::int64_t tile_begin, std::int64_t tile_end) {
  return *run_photometric("photometric_bwd", renders, targets, masks, &l1_weights, &ssim_weights, false,
                          tile_size, tile_begin, tile_end)
              .v_renders;
}

std::tuple<Tensor, Tensor, Tensor> photometric_fwd_bwd(const Tensor& renders, const Tensor& targets,
                                                       const std::optional<Tensor>& masks,
                                                       const Tensor& l1_weights, const Tensor& ssim_weights,
                                                       std::int64_t tile_size, std::int64_t tile_begin,
                                                       std::int64_t tile_end) {
  PhotometricOutputs out = run_photometric("photometric_fwd_bwd", renders, targets, masks, &l1_weights,
                                           &ssim_weights, true, tile_size, tile_begin, tile_end);
  return {*out.l1_sums, *out.ssim_sums, *out.v_renders};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("photometric_fwd", TORCH_BOX(&blitzgs::photometric_fwd));
  m.impl("photometric_bwd", TORCH_BOX(&blitzgs::photometric_bwd));
  m.impl("photometric_fwd_bwd", TORCH_BOX(&blitzgs::photometric_fwd_bwd));
}
