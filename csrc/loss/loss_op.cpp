// SPDX-License-Identifier: Apache-2.0
#include "loss/photometric.h"

#include <cmath>
#include <optional>
#include <tuple>
#include <vector>

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
  BLITZGS_CHECK(tile_size > 0 && tile_size <= 4096, op, "tile_size must be in [1, 4096], got ", tile_size);
  BLITZGS_CHECK(height < (1 << 24) && width < (1 << 24), op, "images of ", width, " x ", height,
                " pixels are beyond the limit of 2^24 a side");
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
  dispatch_floating(renders, [&]<class T>() {
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
  dispatch_floating(renders, [&]<class T>() {
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

std::tuple<Tensor, Tensor> l1_ssim_fwd_bwd(const Tensor& renders, const Tensor& targets,
                                           const Tensor& l1_weights, const Tensor& ssim_weights,
                                           const Tensor& samples, double l1_factor, double ssim_factor,
                                           double offset) {
  const auto outputs = photometric_fwd_bwd(renders, targets, std::nullopt, l1_weights, ssim_weights, 16, 0,
                                           -1, samples, std::nullopt, 0, 0);
  const Tensor &parts = std::get<0>(outputs), &v_renders = std::get<1>(outputs);
  const double* sums = data<double>(parts);
  const std::int64_t n = parts.size(0) * parts.size(1);
  Tensor loss = make_empty(renders, {});
  DeviceScope scope(renders);
  dispatch_floating(renders, [&]<class T>() {
    const LossOfSums<T> args{sums, n, l1_factor, ssim_factor, offset, mutable_data<T>(loss)};
    backend::loss_of_sums(args, scope.workspace, scope.stream);
  });
  return {loss, v_renders};
}

void report_(const std::optional<Tensor>& parts_in, const std::optional<Tensor>& tile_work_in,
             std::int64_t tile_begin, std::int64_t tile_end, std::int64_t rank, std::int64_t n_ranks,
             std::vector<Tensor> targets) {
  constexpr const char* kOp = "report_";
  Report<float> report{};
  const auto parts = checked(kOp, "parts", parts_in, ScalarType::Double, {-1, -1, 2});
  if (parts) {
    report.views = parts->size(0);
    report.n_parts = parts->size(1);
    report.parts = data<double>(*parts);
  }
  const auto tile_work = checked(kOp, "tile_work", tile_work_in, ScalarType::Int, {-1});
  report.tile_work = data_or_null<std::int32_t>(tile_work);
  const std::int64_t tiles = tile_work ? tile_work->size(0) : 0;
  check_tile_range(kOp, tile_begin, tile_end, tiles);
  report.tile_begin = tile_begin;
  report.tile_end = tile_end;
  BLITZGS_CHECK(rank >= 0 && rank < n_ranks, kOp, "rank must be in [0, ", n_ranks, "), got ", rank);
  const auto count = static_cast<std::int64_t>(targets.size());
  BLITZGS_CHECK(count > 0 && count <= kMaxReportTargets, kOp, "1 to ", kMaxReportTargets,
                " targets are supported, got ", count);
  for (Tensor& target : targets) {
    check_in_place(kOp, "a target", target, ScalarType::Float, {2 * report.views * n_ranks + tiles});
    float* sums = mutable_data<float>(target);
    float* mine = sums + 2 * report.views * rank;
    report.targets[report.n_targets++] = {mine, mine + report.views, sums + 2 * report.views * n_ranks};
  }
  DeviceScope scope(parts ? *parts : tile_work ? *tile_work : targets[0]);
  backend::report(report, scope.workspace, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("photometric_fwd", TORCH_BOX(&blitzgs::photometric_fwd));
  m.impl("photometric_bwd", TORCH_BOX(&blitzgs::photometric_bwd));
  m.impl("photometric_fwd_bwd", TORCH_BOX(&blitzgs::photometric_fwd_bwd));
  m.impl("l1_ssim_fwd_bwd", TORCH_BOX(&blitzgs::l1_ssim_fwd_bwd));
  m.impl("report_", TORCH_BOX(&blitzgs::report_));
}
