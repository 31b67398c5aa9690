// SPDX-License-Identifier: Apache-2.0
// Ranks that reach each other's memory: rows written where they are needed, and a meeting of all ranks on the
// device. CUDA only. Every rank holds the same kind of buffers; `buffers[m]` is rank m's, mapped here.
//
// Rows for other ranks are written by project_rows_to_peers_: each group goes into its rank's buffer behind
// the groups of the ranks before this one, column c from word capacity * begin[c] on.
//
// The way back needs no op of its own: the owner of rows reads their gradients where the ranks that
// composited them added them up (TableRowGradients, project/row_gradients.h).
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

namespace cuda {
// known: null, or memory of the host.
void meet(const PeerMail&, std::int64_t meeting, const std::int64_t* values, int n_values, std::int64_t first,
          double timeout_seconds, std::int64_t* known, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
