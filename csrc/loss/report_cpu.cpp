// SPDX-License-Identifier: Apache-2.0
#include "loss/report.h"

namespace blitzgs::cpu {

template <class T>
void report(const Report<T>& report, Workspace&, CudaStream) {
  for (std::int64_t view = 0; view < report.views; ++view) {
    const double* parts = report.parts + 2 * view * report.n_parts;
    double l1 = 0, ssim = 0;
    for (std::int64_t i = 0; i < report.n_parts; ++i) l1 += parts[2 * i], ssim += parts[2 * i + 1];
    for (int m = 0; m < report.n_targets; ++m) {
      report.targets[m].l1[view] = static_cast<T>(l1);
      report.targets[m].ssim[view] = static_cast<T>(ssim);
    }
  }
  for (int m = 0; m < report.n_targets; ++m) {
    for (std::int64_t tile = report.tile_begin; tile < report.tile_end; ++tile) {
      report.targets[m].tiles[tile] = static_cast<T>(report.tile_work[tile]);
    }
  }
}

template void report<float>(const Report<float>&, Workspace&, CudaStream);
template void report<double>(const Report<double>&, Workspace&, CudaStream);

template <class T>
void loss_of_sums(const LossOfSums<T>& args, Workspace&, CudaStream) {
  double l1 = 0, ssim = 0;
  for (std::int64_t i = 0; i < args.n; ++i) l1 += args.parts[2 * i], ssim += args.parts[2 * i + 1];
  *args.loss = static_cast<T>(args.offset + args.l1_weight * l1 + args.ssim_weight * ssim);
}

template void loss_of_sums<float>(const LossOfSums<float>&, Workspace&, CudaStream);
template void loss_of_sums<double>(const LossOfSums<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
