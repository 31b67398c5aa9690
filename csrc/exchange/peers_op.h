// SPDX-License-Identifier: Apache-2.0
// The checked buffers of all ranks, for the ops that write to them.
#pragma once
#include "exchange/scatter_op.h"
#include "exchange/transport.h"

namespace blitzgs {

// Checks that there is one buffer for each rank and that all have the same length and dtype.
inline void check_peers(const char* op, const std::vector<Tensor>& buffers, ScalarType dtype) {
  const auto count = static_cast<std::int64_t>(buffers.size());
  STD_TORCH_CHECK(count >= 1 && count <= kMaxPeers, "blitzgs::", op, ": 1 to ", kMaxPeers,
                  " peers are supported, got ", count);
  for (const Tensor& buffer : buffers) {
    check_in_place(op, "a buffer", buffer, dtype, {buffers[0].size(0)});
  }
}

// The addresses of the columns in each rank's buffer, for columns with a capacity of `capacity` splats.
template <class Word>
ScatterTargets peer_targets(const char* op, std::vector<Tensor>& buffers, const SplatColumns<Word>& columns,
                            std::int64_t capacity, int n_ranks) {
  check_peers(op, buffers, ScalarType::Int);
  STD_TORCH_CHECK(static_cast<int>(buffers.size()) == n_ranks, "blitzgs::", op, ": ", n_ranks,
                  " ranks need as many buffers, got ", buffers.size());
  STD_TORCH_CHECK(capacity >= 0 && capacity <= std::numeric_limits<std::int32_t>::max() &&
                      capacity * columns.begin[columns.count] <= buffers[0].size(0),
                  "blitzgs::", op, ": ", capacity, " splats do not fit into a buffer of ", buffers[0].size(0),
                  " words");
  ScatterTargets targets{};
  for (int m = 0; m < n_ranks; ++m) {
    for (int c = 0; c < columns.count; ++c) {
      targets.words[m][c] = mutable_data<std::int32_t>(buffers[m]) + capacity * columns.begin[c];
    }
  }
  return targets;
}

}  // namespace blitzgs
