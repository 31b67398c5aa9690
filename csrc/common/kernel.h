// SPDX-License-Identifier: Apache-2.0
// Definitions that the kernels of both backends and their callers share: limits, scratch memory, the number
// of splats, and the gradient of a splat. This header does not include torch.
#pragma once
#include <cstddef>
#include <cstdint>
#include <tuple>

// Marks inline maths that g++ and nvcc both compile.

#ifdef __CUDACC__
#define BLITZGS_HD __host__ __device__ __forceinline__
#else
#define BLITZGS_HD inline
#endif

// The namespace of the kernels of the backend that a file is compiled for. Headers declare both backends'
// functions once, in this namespace; the files that define them name `cpu` or `cuda`.

#ifdef BLITZGS_BACKEND_CUDA
#define BLITZGS_BACKEND cuda
#else
#define BLITZGS_BACKEND cpu
#endif

struct CUstream_st;  // cudaStream_t is a pointer to this; declared so that no CUDA header is needed

namespace blitzgs {

// Limits that several ops share.
inline constexpr int kMaxViews = 32;   // views of one launch: an int32 holds a bit for each
inline constexpr int kMaxRanks = 63;   // ranks of a job: a non-negative int64 holds a bit for each
inline constexpr int kMaxLevels = 32;  // octree levels
inline constexpr int kMaxPeers = 16;   // ranks that write to each other's memory

// Scratch memory that lives until the op returns (CUDA: the caching allocator, in stream order).
class Workspace {
 public:
  virtual ~Workspace() = default;
  virtual void* allocate_bytes(size_t bytes) = 0;

  template <class T> T* allocate(int64_t count) {
    return static_cast<T*>(allocate_bytes(size_t(count) * sizeof(T)));
  }
};

using CudaStream = CUstream_st*;

// Uninitialised arrays of one length in one piece of scratch memory, each aligned for any type: each
// allocation takes the host microseconds, during which the device waits for the next launch.
template <class... T> std::tuple<T*...> allocate_arrays(int64_t length, Workspace& workspace) {
  constexpr size_t kAlignment = 256;
  const auto bytes = [&](size_t size) {
    return (size_t(length) * size + kAlignment - 1) / kAlignment * kAlignment;
  };
  auto* next = static_cast<std::byte*>(workspace.allocate_bytes((bytes(sizeof(T)) + ...)));
  const auto take = [&](size_t size) {
    void* const array = next;
    next += bytes(size);
    return array;
  };
  return {static_cast<T*>(take(sizeof(T)))...};  // the braces guarantee the order of the calls
}

// The number of valid splats. The host queues an op before it knows how many splats earlier ops make. The op
// gets columns of n_splats splats and a pointer `known` (null: all are valid) to their number in device
// memory: the first *known are valid, and the memory after them is undefined and not read. A number outside
// [0, n_splats] counts as 0: the splats exceeded the capacity, and the caller discards the result. Kernels
// read it after wait_for_earlier_kernels().
BLITZGS_HD int64_t valid_splat_count(int64_t n_splats, const int64_t* known) {
  if (!known) return n_splats;
  const int64_t count = *known;
  return 0 <= count && count <= n_splats ? count : 0;
}

template <class Input> BLITZGS_HD int64_t valid_splat_count(const Input& in) {
  return valid_splat_count(in.n_splats, in.known_splats);
}

// The gradient of one splat, which on CUDA goes from the rasteriser's backward pass to the projection's.
// Python reads this layout through the op splat_gradient_layout.
struct alignas(16) SplatGradient {
  float mean2d[2], conic[3], opacity;
  float color[4];       // up to four channels; zeros after the last
  float mean2d_abs[2];  // sums over pixels of the absolute gradients of mean2d, if absgrad is set
};

inline constexpr int64_t kSplatGradient = sizeof(SplatGradient) / sizeof(float);

// The rasteriser's kernels move the gradient as three pieces of 16 bytes and rely on these offsets.
static_assert(kSplatGradient == 12 && offsetof(SplatGradient, conic) == 8 &&
              offsetof(SplatGradient, opacity) == 20 && offsetof(SplatGradient, color) == 24 &&
              offsetof(SplatGradient, mean2d_abs) == 40);

}  // namespace blitzgs
