// SPDX-License-Identifier: Apache-2.0
#include <optional>
#include <tuple>
#include <vector>

#include "common/op.h"
#include "loss/loss_of_sums.h"

namespace blitzgs {

// Defined in photometric_op.cpp.
std::tuple<Tensor, Tensor, Tensor, Tensor> photometric_fwd_bwd(
    const Tensor& renders, const Tensor& targets, const std::optional<Tensor>& masks,
    const Tensor& l1_weights, const Tensor& ssim_weights, std::int64_t tile_size, std::int64_t tile_begin,
    std::int64_t tile_end, const std::optional<Tensor>& samples, const std::optional<Tensor>& visible,
    double scale_weight, double opacity_weight);

namespace {

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
  dispatch_floating(renders, [&](auto zero) {
    using T = decltype(zero);
    const LossOfSums<T> args{sums, n, l1_factor, ssim_factor, offset, mutable_data<T>(loss)};
    backend::loss_of_sums(args, scope.workspace, scope.stream);
  });
  return {loss, v_renders};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("l1_ssim_fwd_bwd", TORCH_BOX(&blitzgs::l1_ssim_fwd_bwd)); }
