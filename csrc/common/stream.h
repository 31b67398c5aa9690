// SPDX-License-Identifier: Apache-2.0
// What the signatures of CPU and CUDA kernels need in common: the stream in which work is queued, and the
// source of scratch memory. No torch here.
#pragma once
#include <cstddef>
#include <cstdint>

struct CUstream_st;  // cudaStream_t is a pointer to this; declared so that no CUDA header is needed

namespace blitzgs {

// Scratch memory that lives until the op returns (CUDA: the caching allocator, in stream order).
class Workspace {
 public:
  virtual ~Workspace() = default;
  virtual void* allocate_bytes(std::size_t bytes) = 0;

  template <class T>
  T* allocate(std::int64_t count) {
    return static_cast<T*>(allocate_bytes(static_cast<std::size_t>(count) * sizeof(T)));
  }
};

using CudaStream = CUstream_st*;

}  // namespace blitzgs
