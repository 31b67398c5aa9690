// SPDX-License-Identifier: Apache-2.0
#include "common/cuda.cuh"
#include "population/take_rows.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// out [n] (take_rows.h). A block copies kThreads rows, a thread one word at a time. units: the words in a
// row.
template <class Word>
__global__ void __launch_bounds__(kThreads) take_rows_kernel(const TakeRows take, std::uint32_t units) {
  __shared__ std::int64_t rows[kThreads];
  const std::int64_t first = blockIdx.x * std::int64_t{kThreads};
  const auto n = static_cast<std::uint32_t>(take.n - first < kThreads ? take.n - first : kThreads);
  if (threadIdx.x < n) rows[threadIdx.x] = take.rows[first + threadIdx.x];
  __syncthreads();
  const auto* column = reinterpret_cast<const Word*>(take.column);
  const auto* fresh = reinterpret_cast<const Word*>(take.fresh);
  Word* out = reinterpret_cast<Word*>(take.out) + first * units;
#pragma unroll 4
  for (std::uint32_t i = threadIdx.x; i < n * units; i += kThreads) {
    const std::uint32_t place = i / units;
    const std::int64_t row = rows[place];
    const std::int64_t k = i - place * units;
    Word word{};
    if (row < take.count) {
      word = column[row * units + k];
    } else if (fresh) {
      word = fresh[(row - take.count) * units + k];
    }
    out[i] = word;
  }
}

// Launches the kernel and returns true if the rows are whole, aligned numbers of words of this type.
template <class Word>
bool launch_if_whole(const TakeRows& take, CudaStream stream) {
  const auto places = reinterpret_cast<std::uintptr_t>(take.column) |
                      reinterpret_cast<std::uintptr_t>(take.fresh) |
                      reinterpret_cast<std::uintptr_t>(take.out);
  if (take.row_bytes % sizeof(Word) != 0 || places % sizeof(Word) != 0) return false;
  take_rows_kernel<Word><<<blocks_for(take.n, kThreads), kThreads, 0, stream>>>(
      take, static_cast<std::uint32_t>(take.row_bytes / sizeof(Word)));
  check_launch("take_rows");
  return true;
}

}  // namespace

void take_rows(const TakeRows& take, Workspace&, CudaStream stream) {
  if (take.n == 0 || take.row_bytes == 0) return;
  if (launch_if_whole<uint4>(take, stream) || launch_if_whole<uint2>(take, stream)) return;
  if (launch_if_whole<std::uint32_t>(take, stream)) return;
  launch_if_whole<std::uint8_t>(take, stream);
}

}  // namespace blitzgs::cuda
