// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "population/copy_rows.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// out (copy_rows.h). A block copies kThreads rows, a thread one word at a time. units: the words in a row.
template <class Word>
__global__ void __launch_bounds__(kThreads) copy_rows_kernel(const CopyRows copy, std::uint32_t units) {
  __shared__ std::int64_t from[kThreads], to[kThreads];
  const std::int64_t first = blockIdx.x * std::int64_t{kThreads};
  const auto n = static_cast<std::uint32_t>(copy.n - first < kThreads ? copy.n - first : kThreads);
  if (threadIdx.x < n) {
    const std::int64_t i = first + threadIdx.x;
    from[threadIdx.x] = copy.from ? copy.from[i] : i;
    to[threadIdx.x] = copy.to ? copy.to[i] : i;
  }
  __syncthreads();
  const auto* column = reinterpret_cast<const Word*>(copy.column);
  Word* out = reinterpret_cast<Word*>(copy.out);
#pragma unroll 4
  for (std::uint32_t i = threadIdx.x; i < n * units; i += kThreads) {
    const std::uint32_t place = i / units;
    const std::int64_t k = i - place * units;
    out[to[place] * units + k] = column ? column[from[place] * units + k] : Word{};
  }
}

// Launches the kernel and returns true if the rows are whole, aligned numbers of words of this type.
template <class Word>
bool launch_if_whole(const CopyRows& copy, CudaStream stream) {
  const auto places =
      reinterpret_cast<std::uintptr_t>(copy.column) | reinterpret_cast<std::uintptr_t>(copy.out);
  if (copy.row_bytes % sizeof(Word) != 0 || places % sizeof(Word) != 0) return false;
  copy_rows_kernel<Word><<<blocks_for(copy.n, kThreads), kThreads, 0, stream>>>(
      copy, static_cast<std::uint32_t>(copy.row_bytes / sizeof(Word)));
  check_launch("copy_rows");
  return true;
}

}  // namespace

void copy_rows(const CopyRows& copy, CudaStream stream) {
  if (copy.n == 0 || copy.row_bytes == 0) return;
  if (launch_if_whole<uint4>(copy, stream) || launch_if_whole<uint2>(copy, stream)) return;
  if (launch_if_whole<std::uint32_t>(copy, stream)) return;
  launch_if_whole<std::uint8_t>(copy, stream);
}

}  // namespace blitzgs::cuda
