// SPDX-License-Identifier: Apache-2.0
// The number of multiprocessors, for launches with as many blocks as run at a time.
#pragma once
#include "common/cuda_check.h"

namespace blitzgs::cuda {

// The number of multiprocessors of the current device.
inline int multiprocessors() {
  int device = 0, count = 0;
  check(cudaGetDevice(&device), "multiprocessors");
  check(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device), "multiprocessors");
  return count;
}

}  // namespace blitzgs::cuda
