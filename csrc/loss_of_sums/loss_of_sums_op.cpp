// SPDX-License-Identifier: Apache-2.0
#include "loss_of_sums/loss_of_sums.h"

#include "common/op.h"

namespace blitzgs {
namespace {

Tensor loss_of_sums(const Tensor& parts_in, const Tensor& like, double l1_weight, double ssim_weight,
                    double offset) {
  constexpr const char* kOp = "loss_of_sums";
  check_shape(kOp, "parts", parts_in, {-1, -1, 2});
  check_dtype(kOp, "parts", parts_in, ScalarType::Double);
  check_floating(kOp, "like", like);
  const Tensor parts = as_contiguous(parts_in);
  Tensor loss = make_empty(parts, {}, like.scalar_type());
  DeviceScope scope(parts);
  dispatch_floating(like, [&](auto zero) {
    using T = decltype(zero);
    const LossOfSums<T> args{
        data<double>(parts),  parts.size(0) * parts.size(1), l1_weight, ssim_weight, offset,
        mutable_data<T>(loss)};
    backend::loss_of_sums(args, scope.workspace, scope.stream);
  });
  return loss;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("loss_of_sums", TORCH_BOX(&blitzgs::loss_of_sums)); }
