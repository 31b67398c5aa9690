// SPDX-License-Identifier: Apache-2.0
// With which CUDA this library was built and for which GPUs, for `blitzgs doctor` (cmake/cuda.cmake).
extern "C" __attribute__((visibility("default"))) const char* blitzgs_cuda_build() {
  return BLITZGS_CUDA_BUILD;
}
