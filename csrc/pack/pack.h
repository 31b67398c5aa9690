// SPDX-License-Identifier: Apache-2.0
// Packing: rows of several columns gathered into one buffer of 32-bit words for the exchange between ranks,
// taken apart again on arrival, and gradients that come back from several ranks added up.
//
//   pack:   columns int32 [P, w_i] (any 4-byte data), rows int32 [S]  ->  packed int32 [S, sum w_i]
//   unpack: packed [S, sum w_i]  ->  columns int32 [S, w_i]
//   add:    values [S, F], rows int32 [S] in groups, one per rank  ->  total [P, F], where total[rows[i]] is
//   the
//           sum of its values in the order of the groups, starting from zero. A row occurs at most once in a
//           group, so no two additions meet: deterministic on every backend.
//
// Plain copies, O(S sum w_i). rows must be in [0, P); the op does not check it (it would wait for the
// device).
#pragma once
#include <cstdint>

#include "common/stream.h"

namespace blitzgs {

constexpr int kMaxPackColumns = 16;

struct PackColumns {
  std::int32_t* words[kMaxPackColumns];  // read by pack, written by unpack
  int begin[kMaxPackColumns + 1];  // first word of each column in a packed row; the last entry is the total
  int count;
};

namespace cpu {
void pack(const PackColumns& columns, const std::int32_t* rows, std::int64_t n, std::int32_t* packed,
          Workspace&, CudaStream);
void unpack(const std::int32_t* packed, std::int64_t n, const PackColumns& columns, Workspace&, CudaStream);
template <class T>
void add_group(const T* values, const std::int32_t* rows, std::int64_t n, int width, T* total, Workspace&,
               CudaStream);
}  // namespace cpu

namespace cuda {
void pack(const PackColumns& columns, const std::int32_t* rows, std::int64_t n, std::int32_t* packed,
          Workspace&, CudaStream);
void unpack(const std::int32_t* packed, std::int64_t n, const PackColumns& columns, Workspace&, CudaStream);
template <class T>
void add_group(const T* values, const std::int32_t* rows, std::int64_t n, int width, T* total, Workspace&,
               CudaStream);
}  // namespace cuda

}  // namespace blitzgs
