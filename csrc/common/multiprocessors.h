// SPDX-License-Identifier: Apache-2.0
// For launches that fill the device once.
#pragma once
#include "common/cuda_check.h"

namespace blitzgs::cuda {

// Of the current device.
inline int multiprocessors() {
  int device = 0, count = 0;
  check(cudaGetDevice(&device), "multiprocessors");
  check(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device), "multiprocessors");
  return count;
}

}  // namespace blitzgs::cuda
