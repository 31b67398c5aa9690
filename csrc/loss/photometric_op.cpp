// SPDX-License-Identifier: Apache-2.0
#include "loss/photometric.h"

#include <cmath>
#include <tuple>

#include "common/op.h"
#include "loss/report.h"

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
  std::optional<Tensor> parts, v_renders, scale_reg, opacity_reg;
};

// The weights of the sums in the loss whose gradient is computed.
struct PhotometricWeights {
  const Tensor& l1;
  const Tensor& ssim;
  std::optional<Tensor> samples, visible;
  double scale = 0, opacity = 0;
};

PhotometricOutputs run_photometric(const char* op, const Tensor& renders_in, const Tensor& targets_in,
                                   const std::optional<Tensor>& masks_in, const PhotometricWeights* weights,
                                   bool sums, std::int64_t tile_size, std::int64_t tile_begin,
                                   std::int64_t tile_end) {
  check_floating(op, "renders", renders_in);
  const ScalarType dtype = renders_in.scalar_type();
  const Tensor renders = checked(op, "renders", renders_in, dtype, {-1, -1, -1, 3});
  const std::int64_t views = renders.size(0), height = renders.size(1), width = renders.size(2);
  check_shape(op, "targets", targets_in, {views, height, width, 3});
  const bool bytes = targets_in.scalar_type() == ScalarType::Byte;
  if (!bytes) check_dtype(op, "targets (if not uint8)", targets_in, dtype);
  const Tensor targets = as_contiguous(targets_in);
  STD_TORCH_CHECK(tile_size > 0 && tile_size <= 4096, "blitzgs::", op,
                  ": tile_size must be in [1, 4096], got ", tile_size);
  STD_TORCH_CHECK(height < (1 << 24) && width < (1 << 24), "blitzgs::", op, ": images of ", width, " x ",
                  height, " pixels are beyond the limit of 2^24 a side");
  const auto masks = checked(op, "masks", masks_in, ScalarType::Byte, {views, height, width});
  std::optional<Tensor> l1_weights, ssim_weights, samples, visible;
  PhotometricOutputs outputs;
  if (weights) {
    l1_weights = checked(op, "l1_weights", weights->l1, dtype, {views});
    ssim_weights = checked(op, "ssim_weights", weights->ssim, dtype, {views});
    samples = checked(op, "samples", weights->samples, dtype, {views});
    visible = checked(op, "visible", weights->visible, ScalarType::Long, {views});
    outputs.v_renders = make_empty(renders, {views, height, width, 3});
    outputs.scale_reg = make_empty(renders, {visible ? views : 0});
    outputs.opacity_reg = make_empty(renders, {visible ? views : 0});
  }
  if (renders.numel() == 0) {
    if (visible) {
      torch::stable::zero_(*outputs.scale_reg);
      torch::stable::zero_(*outputs.opacity_reg);
    }
    if (sums) outputs.parts = make_empty(renders, {views, 0, 2}, ScalarType::Double);
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
    args.samples = data_or_null<T>(samples);
    if (visible) {
      args.means = {data<std::int64_t>(*visible), static_cast<T>(weights->scale),
                    static_cast<T>(weights->opacity), mutable_data<T>(*outputs.scale_reg),
                    mutable_data<T>(*outputs.opacity_reg)};
    }
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
    check_tile_range(op, tile_begin, args.tile_end, tiles);
    fill_window(args.window);
    if (sums) {
      outputs.parts = make_empty(renders, {views, backend::photometric_parts(args), 2}, ScalarType::Double);
      args.parts = mutable_data<double>(*outputs.parts);
    }
    backend::photometric(args, scope.workspace, scope.stream);
  });
  return outputs;
}

std::tuple<Tensor, Tensor> photometric_fwd(const Tensor& renders, const Tensor& targets,
                                           const std::optional<Tensor>& masks, std::int64_t tile_size,
                                           std::int64_t tile_begin, std::int64_t tile_end) {
  const Tensor parts = *run_photometric("photometric_fwd", renders, targets, masks, nullptr, true, tile_size,
                                        tile_begin, tile_end)
                            .parts;
  const std::int64_t views = parts.size(0);
  Tensor l1_sums = make_empty(renders, {views}), ssim_sums = make_empty(renders, {views});
  DeviceScope scope(renders);
  dispatch_floating(renders, [&](auto zero) {
    using T = decltype(zero);
    Report<T> report{data<double>(parts), views, parts.size(1), nullptr, 0, 0, {}, 1};
    report.targets[0] = {mutable_data<T>(l1_sums), mutable_data<T>(ssim_sums), nullptr};
    backend::report(report, scope.workspace, scope.stream);
  });
  return {l1_sums, ssim_sums};
}

Tensor photometric_bwd(const Tensor& renders, const Tensor& targets, const std::optional<Tensor>& masks,
                       const Tensor& l1_weights, const Tensor& ssim_weights, std::int64_t tile_size,
                       std::int64_t tile_begin, std::int64_t tile_end) {
  const PhotometricWeights weights{l1_weights, ssim_weights, {}, {}};
  return *run_photometric("photometric_bwd", renders, targets, masks, &weights, false, tile_size, tile_begin,
                          tile_end)
              .v_renders;
}

}  // namespace

// Not in the unnamed namespace, because l1_ssim_op.cpp calls it, too.
std::tuple<Tensor, Tensor, Tensor, Tensor> photometric_fwd_bwd(
    const Tensor& renders, const Tensor& targets, const std::optional<Tensor>& masks,
    const Tensor& l1_weights, const Tensor& ssim_weights, std::int64_t tile_size, std::int64_t tile_begin,
    std::int64_t tile_end, const std::optional<Tensor>& samples, const std::optional<Tensor>& visible,
    double scale_weight, double opacity_weight) {
  const PhotometricWeights weights{l1_weights, ssim_weights, samples, visible, scale_weight, opacity_weight};
  PhotometricOutputs out = run_photometric("photometric_fwd_bwd", renders, targets, masks, &weights, true,
                                           tile_size, tile_begin, tile_end);
  return {*out.parts, *out.v_renders, *out.scale_reg, *out.opacity_reg};
}

}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("photometric_fwd", TORCH_BOX(&blitzgs::photometric_fwd));
  m.impl("photometric_bwd", TORCH_BOX(&blitzgs::photometric_bwd));
  m.impl("photometric_fwd_bwd", TORCH_BOX(&blitzgs::photometric_fwd_bwd));
}
