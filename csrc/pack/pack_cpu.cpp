// SPDX-License-Identifier: Apache-2.0
#include "pack/pack.h"

#include <cstring>

#include "common/parallel.h"

namespace blitzgs::cpu {

void pack(const PackColumns& columns, const std::int32_t* rows, std::int64_t n, std::int32_t* packed,
          Workspace&, CudaStream) {
  const std::int64_t total = columns.begin[columns.count];
  parallel_for(0, n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      for (int c = 0; c < columns.count; ++c) {
        const std::int64_t width = columns.begin[c + 1] - columns.begin[c];
        std::memcpy(packed + i * total + columns.begin[c], columns.words[c] + rows[i] * width, 4 * width);
      }
    }
  });
}

void unpack(const std::int32_t* packed, std::int64_t n, const PackColumns& columns, Workspace&, CudaStream) {
  const std::int64_t total = columns.begin[columns.count];
  parallel_for(0, n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      for (int c = 0; c < columns.count; ++c) {
        const std::int64_t width = columns.begin[c + 1] - columns.begin[c];
        std::memcpy(columns.words[c] + i * width, packed + i * total + columns.begin[c], 4 * width);
      }
    }
  });
}

template <class T>
void add_group(const T* values, const std::int32_t* rows, std::int64_t n, int width, T* total, Workspace&,
               CudaStream) {
  parallel_for(0, n, 1 << 12, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      T* target = total + static_cast<std::int64_t>(rows[i]) * width;
      for (int f = 0; f < width; ++f) target[f] += values[i * width + f];
    }
  });
}

template void add_group<float>(const float*, const std::int32_t*, std::int64_t, int, float*, Workspace&,
                               CudaStream);
template void add_group<double>(const double*, const std::int32_t*, std::int64_t, int, double*, Workspace&,
                                CudaStream);

}  // namespace blitzgs::cpu
