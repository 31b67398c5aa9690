// SPDX-License-Identifier: Apache-2.0
// The buffers of all ranks, checked the same way in every op that writes to them.
#pragma once
#include "scatter/scatter_op.h"
#include "transport/transport.h"

namespace blitzgs {

// One buffer for each rank, all alike.
inline void check_peers(const char* op, const std::vector<Tensor>& buffers, ScalarType dtype) {
  const auto count = static_cast<std::int64_t>(buffers.size());
  STD_TORCH_CHECK(count >= 1 && count <= kMaxPeers, "blitzgs::", op, ": 1 to ", kMaxPeers,
                  " peers are supported, got ", count);
  for (const Tensor& buffer : buffers) {
    check_in_place(op, "a buffer", buffer, dtype, {buffers[0].size(0)});
  }
}

// Where the columns of each rank's buffer begin when they are `capacity` splats long.
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
