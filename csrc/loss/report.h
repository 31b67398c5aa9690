// SPDX-License-Identifier: Apache-2.0
// The report of a training step: the sums of the loss, added up from the parts that the photometric kernel
// wrote, and the costs of this rank's tiles. One launch writes the report to the memory of every rank that
// reads it.
//
//   parts double [B, K, 2], sums of |x - y| and of SSIM of each view in K parts -> l1 [B], ssim [B]
//   tile_work int32 [tiles], of which [tile_begin, tile_end) are this rank's  -> tiles [tiles], only those
//
// Parts are added in a fixed order. CPU and CUDA agree to the rounding of doubles.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

constexpr int kMaxReportTargets = 16;

// The memory of one rank that gets the report, a peer's or this rank's own.
template <class T>
struct ReportTarget {
  T* l1;
  T* ssim;
  T* tiles;
};

template <class T>
struct Report {
  const double* parts;
  std::int64_t views, n_parts;
  const std::int32_t* tile_work;
  std::int64_t tile_begin, tile_end;
  ReportTarget<T> targets[kMaxReportTargets];
  int n_targets;
};

// The loss of views from the partial sums that the photometric kernel wrote, in one launch:
//   loss = offset + sum over i of (l1_weight parts[i][0] + ssim_weight parts[i][1]),  0 <= i < n.
// Parts are added in a fixed order. CPU and CUDA agree to the rounding of doubles.

template <class T>
struct LossOfSums {
  const double* parts;
  std::int64_t n;
  double l1_weight, ssim_weight, offset;
  T* loss;
};

namespace BLITZGS_BACKEND {
template <class T>
void loss_of_sums(const LossOfSums<T>&, Workspace&, CudaStream);
template <class T>
void report(const Report<T>& report, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
