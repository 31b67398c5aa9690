// SPDX-License-Identifier: Apache-2.0
#include "common/cuda_check.h"
#include "pack/pack.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;

// One thread per word of the packed buffer, so that its reads or writes are contiguous.
template <bool kPack>
__global__ void move_words(PackColumns columns, const std::int32_t* rows, std::int64_t n_words,
                           std::int32_t* packed) {
  const std::int64_t at = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (at >= n_words) return;
  const int total = columns.begin[columns.count];
  const std::int64_t i = at / total;
  const int word = static_cast<int>(at - i * total);
  int c = 0;
  while (word >= columns.begin[c + 1]) ++c;
  const int width = columns.begin[c + 1] - columns.begin[c];
  const std::int64_t row = kPack ? rows[i] : i;
  std::int32_t* element = columns.words[c] + row * width + (word - columns.begin[c]);
  if constexpr (kPack) {
    packed[at] = *element;
  } else {
    *element = packed[at];
  }
}

template <class T>
__global__ void add_group_kernel(const T* values, const std::int32_t* rows, std::int64_t n_values, int width,
                                 T* total) {
  const std::int64_t at = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (at >= n_values) return;
  const std::int64_t i = at / width;
  total[static_cast<std::int64_t>(rows[i]) * width + (at - i * width)] += values[at];
}

}  // namespace

void pack(const PackColumns& columns, const std::int32_t* rows, std::int64_t n, std::int32_t* packed,
          Workspace&, CudaStream stream) {
  const std::int64_t words = n * columns.begin[columns.count];
  if (words == 0) return;
  move_words<true><<<blocks_for(words, kThreads), kThreads, 0, stream>>>(columns, rows, words, packed);
  check_launch("pack_rows");
}

void unpack(const std::int32_t* packed, std::int64_t n, const PackColumns& columns, Workspace&,
            CudaStream stream) {
  const std::int64_t words = n * columns.begin[columns.count];
  if (words == 0) return;
  move_words<false><<<blocks_for(words, kThreads), kThreads, 0, stream>>>(columns, nullptr, words,
                                                                          const_cast<std::int32_t*>(packed));
  check_launch("unpack_rows");
}

template <class T>
void add_group(const T* values, const std::int32_t* rows, std::int64_t n, int width, T* total, Workspace&,
               CudaStream stream) {
  if (n * width == 0) return;
  add_group_kernel<<<blocks_for(n * width, kThreads), kThreads, 0, stream>>>(values, rows, n * width, width,
                                                                             total);
  check_launch("add_rows");
}

template void add_group<float>(const float*, const std::int32_t*, std::int64_t, int, float*, Workspace&,
                               CudaStream);

}  // namespace blitzgs::cuda
