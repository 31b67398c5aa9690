// SPDX-License-Identifier: Apache-2.0
// The loss of views from the partial sums that the photometric kernel wrote, in one launch:
//   loss = offset + sum over i of (l1_weight parts[i][0] + ssim_weight parts[i][1]),  0 <= i < n.
// Parts are added in a fixed order. CPU and CUDA agree to the rounding of doubles.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

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
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
