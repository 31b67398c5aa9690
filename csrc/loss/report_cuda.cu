// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "loss/photometric.h"

namespace blitzgs::cuda {
namespace {

constexpr int kReportThreads = 256;

// Writes the report (photometric.h). Each of the first B blocks sums the parts of a view; in the others a
// thread copies the cost of a tile.
__global__ void __launch_bounds__(kReportThreads)
    report_kernel(const __grid_constant__ Report<float> report) {
  const int64_t view = blockIdx.x;
  if (view >= report.views) {
    const int64_t tile = report.tile_begin + (view - report.views) * kReportThreads + threadIdx.x;
    if (tile >= report.tile_end) return;
    const auto work = float(report.tile_work[tile]);
    for (int m = 0; m < report.n_targets; ++m) report.targets[m].tiles[tile] = work;
    return;
  }
  const double* parts = report.parts + 2 * view * report.n_parts;
  double l1 = 0, ssim = 0;
  for (int64_t i = threadIdx.x; i < report.n_parts; i += kReportThreads) {
    l1 += parts[2 * i], ssim += parts[2 * i + 1];
  }
  l1 = block_sum<kReportThreads>(l1), ssim = block_sum<kReportThreads>(ssim);
  if (threadIdx.x > 0) return;
  for (int m = 0; m < report.n_targets; ++m) {
    report.targets[m].l1[view] = float(l1);
    report.targets[m].ssim[view] = float(ssim);
  }
}

constexpr int kLossThreads = 512;

// The loss (photometric.h), by one block.
__global__ void __launch_bounds__(kLossThreads) loss_of_sums_kernel(const LossOfSums<float> args) {
  double l1 = 0, ssim = 0;
  for (int64_t i = threadIdx.x; i < args.n; i += kLossThreads) {
    l1 += args.parts[2 * i], ssim += args.parts[2 * i + 1];
  }
  l1 = block_sum<kLossThreads>(l1), ssim = block_sum<kLossThreads>(ssim);
  if (threadIdx.x > 0) return;
  *args.loss = float(args.offset + args.l1_weight * l1 + args.ssim_weight * ssim);
}

}  // namespace

template <> void report<float>(const Report<float>& report, CudaStream stream) {
  const auto blocks =
      unsigned(report.views) + blocks_for(report.tile_end - report.tile_begin, kReportThreads);
  if (blocks == 0) return;
  report_kernel<<<blocks, kReportThreads, 0, stream>>>(report);
  check_launch("report");
}

template <> void loss_of_sums<float>(const LossOfSums<float>& args, CudaStream stream) {
  loss_of_sums_kernel<<<1, kLossThreads, 0, stream>>>(args);
  check_launch("loss_of_sums");
}

}  // namespace blitzgs::cuda
