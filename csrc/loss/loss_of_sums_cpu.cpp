// SPDX-License-Identifier: Apache-2.0
#include "loss/loss_of_sums.h"

namespace blitzgs::cpu {

template <class T>
void loss_of_sums(const LossOfSums<T>& args, Workspace&, CudaStream) {
  double l1 = 0, ssim = 0;
  for (std::int64_t i = 0; i < args.n; ++i) l1 += args.parts[2 * i], ssim += args.parts[2 * i + 1];
  *args.loss = static_cast<T>(args.offset + args.l1_weight * l1 + args.ssim_weight * ssim);
}

template void loss_of_sums<float>(const LossOfSums<float>&, Workspace&, CudaStream);
template void loss_of_sums<double>(const LossOfSums<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
