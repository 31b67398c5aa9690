// SPDX-License-Identifier: Apache-2.0
#include "loss/photometric.h"

#include "common/op.h"

namespace blitzgs {
namespace {

template <class T> void fill_window(T (&window)[kSsimTaps]) {
  double values[kSsimTaps], total = 0;
  for (int i = 0; i < kSsimTaps; ++i) {
    values[i] = std::exp(-(i - kSsimRadius) * (i - kSsimRadius) / (2 * 1.5 * 1.5));
    total += values[i];
  }
  for (int i = 0; i < kSsimTaps; ++i) window[i] = T(values[i] / total);
}

// The weights of the sums in the loss whose gradient is computed.
struct PhotometricWeights {
  const Tensor& l1;
  const Tensor& ssim;
  OptionalTensor samples, visible;
  double scale = 0, opacity = 0;
};

// weights null: no gradient. sums: whether the sums are wanted.
Tensors<4> run_photometric(const Tensor& renders_in, const Tensor& targets_in, const OptionalTensor& masks_in,
                           const PhotometricWeights* weights, bool sums, int64_t tile_size,
                           int64_t tile_begin, int64_t tile_end) {
  check_floating("renders", renders_in);
  check_shape("renders", renders_in, {-1, -1, -1, 3});
  const int64_t views = renders_in.size(0), height = renders_in.size(1), width = renders_in.size(2);
  check_shape("targets", targets_in, {views, height, width, 3});
  const bool bytes = targets_in.scalar_type() == ScalarType::Byte;
  if (!bytes) check_dtype("targets (if not uint8)", targets_in, renders_in.scalar_type());
  const Tensor targets = as_contiguous(targets_in);
  BLITZGS_CHECK(tile_size > 0 && tile_size <= 4096, "tile_size must be in [1, 4096], got ", tile_size);
  BLITZGS_CHECK(height < (1 << 24) && width < (1 << 24), "images of ", width, " x ", height,
                " pixels are beyond the limit of 2^24 a side");
  const auto masks = checked<uint8_t>("masks", masks_in, {views, height, width});
  DeviceScope scope(renders_in);
  return dispatch_floating(renders_in, [&]<class T>() -> Tensors<4> {
    const auto renders = checked<T>("renders", renders_in, {views, height, width, 3});
    OptionalValues<const T> l1_weights, ssim_weights, samples;
    OptionalValues<const int64_t> visible;
    if (weights) {
      l1_weights.emplace(checked<T>("l1_weights", weights->l1, {views}));
      ssim_weights.emplace(checked<T>("ssim_weights", weights->ssim, {views}));
      samples = checked<T>("samples", weights->samples, {views});
      visible = checked<int64_t>("visible", weights->visible, {views});
    }
    const auto v_renders = make<T>(renders, {weights ? views : 0, height, width, 3});
    auto scale_reg = make<T>(renders, {visible ? views : 0}),
         opacity_reg = make<T>(renders, {visible ? views : 0});
    if (renders.numel() == 0) {
      torch::stable::zero_(scale_reg);
      torch::stable::zero_(opacity_reg);
      return {make<double>(renders, {views, 0, 2}), v_renders, scale_reg, opacity_reg};
    }
    PhotometricArgs<T> args{};
    args.renders = renders;
    args.targets = bytes ? nullptr : data<T>(targets);
    args.targets_u8 = bytes ? data<uint8_t>(targets) : nullptr;
    args.masks = masks;
    args.l1_weights = l1_weights;
    args.ssim_weights = ssim_weights;
    args.samples = samples;
    if (visible) args.means = {visible, T(weights->scale), T(weights->opacity), scale_reg, opacity_reg};
    args.v_renders = v_renders.data_if(weights != nullptr);
    args.clear_rest = !sums;
    args.views = views;
    args.width = int(width);
    args.height = int(height);
    args.tile_size = int(tile_size);
    args.tiles_x = int((width + tile_size - 1) / tile_size);
    args.tiles_y = int((height + tile_size - 1) / tile_size);
    args.tile_begin = tile_begin;
    const int64_t tiles = views * args.tiles_x * args.tiles_y;
    args.tile_end = tile_end < 0 ? tiles : tile_end;
    check_tile_range(tile_begin, args.tile_end, tiles);
    fill_window(args.window);
    const auto parts = make<double>(renders, {views, sums ? backend::photometric_parts(args) : 0, 2});
    args.parts = parts.data_if(sums);
    backend::photometric(args, scope.workspace, scope.stream);
    return {parts, v_renders, scale_reg, opacity_reg};
  });
}

Tensors<2> photometric_fwd(const Tensor& renders, const Tensor& targets, const OptionalTensor& masks,
                           int64_t tile_size, int64_t tile_begin, int64_t tile_end) {
  const Tensor parts =
      std::get<0>(run_photometric(renders, targets, masks, nullptr, true, tile_size, tile_begin, tile_end));
  const int64_t views = parts.size(0);
  DeviceScope scope(renders);
  return dispatch_floating(renders, [&]<class T>() -> Tensors<2> {
    const auto l1_sums = make<T>(renders, {views}), ssim_sums = make<T>(renders, {views});
    const Report<T> report{
        data<double>(parts), views, parts.size(1), nullptr, 0, 0, {{l1_sums, ssim_sums, nullptr}}, 1};
    backend::report(report, scope.stream);
    return {l1_sums, ssim_sums};
  });
}

Tensor photometric_bwd(const Tensor& renders, const Tensor& targets, const OptionalTensor& masks,
                       const Tensor& l1_weights, const Tensor& ssim_weights, int64_t tile_size,
                       int64_t tile_begin, int64_t tile_end) {
  const PhotometricWeights weights{l1_weights, ssim_weights, {}, {}};
  return std::get<1>(
      run_photometric(renders, targets, masks, &weights, false, tile_size, tile_begin, tile_end));
}

Tensors<4> photometric_fwd_bwd(const Tensor& renders, const Tensor& targets, const OptionalTensor& masks,
                               const Tensor& l1_weights, const Tensor& ssim_weights, int64_t tile_size,
                               int64_t tile_begin, int64_t tile_end, const OptionalTensor& samples,
                               const OptionalTensor& visible, double scale_weight, double opacity_weight) {
  const PhotometricWeights weights{l1_weights, ssim_weights, samples, visible, scale_weight, opacity_weight};
  return run_photometric(renders, targets, masks, &weights, true, tile_size, tile_begin, tile_end);
}

Tensors<2> l1_ssim_fwd_bwd(const Tensor& renders, const Tensor& targets, const Tensor& l1_weights,
                           const Tensor& ssim_weights, const Tensor& samples, double l1_factor,
                           double ssim_factor, double offset) {
  const PhotometricWeights weights{l1_weights, ssim_weights, samples, {}};
  const Tensors<4> out = run_photometric(renders, targets, std::nullopt, &weights, true, 16, 0, -1);
  const Tensor& parts = std::get<0>(out);
  const int64_t n = parts.size(0) * parts.size(1);
  DeviceScope scope(renders);
  return dispatch_floating(renders, [&]<class T>() -> Tensors<2> {
    const auto loss = make<T>(renders, {});
    backend::loss_of_sums(LossOfSums<T>{data<double>(parts), n, l1_factor, ssim_factor, offset, loss},
                          scope.stream);
    return {loss, std::get<1>(out)};
  });
}

void report_(const OptionalTensor& parts_in, const OptionalTensor& tile_work_in, int64_t tile_begin,
             int64_t tile_end, int64_t rank, int64_t n_ranks, const TensorList& targets) {
  const auto parts = checked<double>("parts", parts_in, {-1, -1, 2});
  const auto tile_work = checked<int32_t>("tile_work", tile_work_in, {-1});
  const int64_t tiles = tile_work ? tile_work->size(0) : 0;
  Report<float> report{
      parts, parts ? parts->size(0) : 0, parts ? parts->size(1) : 0, tile_work, tile_begin, tile_end, {}, 0};
  check_tile_range(tile_begin, tile_end, tiles);
  BLITZGS_CHECK(rank >= 0 && rank < n_ranks, "rank must be in [0, ", n_ranks, "), got ", rank);
  const auto count = int64_t(targets.size());
  BLITZGS_CHECK(count > 0 && count <= kMaxReportTargets, "1 to ", kMaxReportTargets,
                " targets are supported, got ", count);
  for (const Tensor& target : targets) {
    float* sums = checked_in_place<float>("a target", target, {2 * report.views * n_ranks + tiles});
    float* mine = sums + 2 * report.views * rank;
    report.targets[report.n_targets++] = {mine, mine + report.views, sums + 2 * report.views * n_ranks};
  }
  DeviceScope scope(parts ? *parts : tile_work ? *tile_work : targets[0]);
  backend::report(report, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "photometric_fwd", photometric_fwd);
  BLITZGS_OP(m, "photometric_bwd", photometric_bwd);
  BLITZGS_OP(m, "photometric_fwd_bwd", photometric_fwd_bwd);
  BLITZGS_OP(m, "l1_ssim_fwd_bwd", l1_ssim_fwd_bwd);
  BLITZGS_OP(m, "report_", report_);
}
