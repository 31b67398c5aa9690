// SPDX-License-Identifier: Apache-2.0
// Ranks that reach each other's memory: rows written where they are needed, and a meeting of all ranks on the
// device. CUDA only. Every rank holds the same kind of buffers; `buffers[m]` is rank m's, mapped here.
//
// Rows for other ranks are written by project_rows_to_peers_: each group goes into its rank's buffer behind
// the groups of the ranks before this one, column c from word capacity * begin[c] on.
//
// return_to_peers_, the way back: the first `width` values of each received row of values [R, W], group m of
// them from rank m, go to rank m's buffer, from row starts[m] of those there, which begin at word `offset`;
// but for this rank's own group. With fronts [M], on the device: only the first fronts[m] rows of each or,
// with `back`, only the rest, which leaves most of the GPU to kernels of other streams.
//
// meet_peers_, a barrier in stream order: what any rank queued before it is done, and visible, when what any
// rank queues behind it runs. Each rank also leaves its `values` with every other. mail[m], int64: [M] the
// last meeting each rank came to; from word `first` on [M, n] their values, then [n] their sums. known [M,
// n], in pinned memory: the values for the host. A rank that waits for longer than timeout_seconds aborts its
// kernels, so that its process sees an error.
#pragma once
#include "scatter/scatter.h"

namespace blitzgs {

constexpr int kMaxPeers = 16;

struct PeerMail {
  std::int64_t* of[kMaxPeers];
  int count, rank;
};

// values [R, stride]. Target m: where the first `width` of each row of group m go, [size[m], width]. fronts:
// null, or that of group m at fronts[m * fronts_stride].
struct PeerReturn {
  const float* values;
  int stride, width;
  RowGroups groups;
  float* targets[kMaxPeers];
  const std::int64_t* fronts;
  std::int64_t fronts_stride;
  int rank;
  bool back;
};

namespace cuda {
// known: null, or memory of the host.
void meet(const PeerMail&, std::int64_t meeting, const std::int64_t* values, int n_values, std::int64_t first,
          double timeout_seconds, std::int64_t* known, Workspace&, CudaStream);
void return_rows(const PeerReturn&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
