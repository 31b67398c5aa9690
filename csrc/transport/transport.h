// SPDX-License-Identifier: Apache-2.0
// How ranks that reach each other's memory exchange splats. CUDA only. Every rank holds the same kind of
// buffers; `buffers[m]` is rank m's, mapped here.
//
// send_splats_ writes each splat to the ranks of its rank mask: into every rank's buffer behind the splats of
// the ranks before this one, column c from word capacity * kSentColumns.begin[c] on. If any rank has more
// than `capacity` splats of its own, to send or to get, no rank writes anything: each finds that from the
// same totals.
//
// The way back needs no op of its own: the owner of splats reads their gradients where the ranks that
// composited them added them up (RankSplatGradients, project/project.h).
//
// device_barrier_, a barrier in stream order: what any rank queued before it is done, and visible, when what
// any rank queues behind it runs. Each rank also leaves its `values` with every other. control[m], int64:
// [M] the number of the last barrier that each rank reached; from word `first` on [M, n] their values, then
// [n] their sums. host [M, n], in pinned memory: the values for the host. A rank that waits for longer than
// timeout_seconds aborts its kernels, so that its process sees an error.
#pragma once
#include "common/kernel.h"
#include "project/project.h"
#include "scatter/scatter.h"

namespace blitzgs {

struct ControlWords {
  std::int64_t* of[kMaxPeers];
  int count, rank;
};

// What other ranks need of a splat: means2d, conics, opacities, colors, depths, camera_ids and the Gaussian's
// persistent id, in words.
inline constexpr SplatColumns<const std::int32_t> kSentColumns{{}, {0, 2, 5, 6, 9, 10, 11, 13}, 7};

// What this rank writes to the others, as its device works it out.
struct SendPlan {
  std::int64_t received;  // splats that arrive here: the first word, for what takes that number on the device
  std::int64_t splats;    // of this rank
  SplatGroups groups;     // splats for each rank, and the splat of its target that they begin at
  std::int64_t filled[kMaxRanks];  // how many of these have been given a place
};

// everyone: project_totals of each rank, on the device; targets: where the columns of each rank's splats
// begin. plan and places are written too.
struct SendArguments {
  ScatterSplats splats;  // columns as kSentColumns has them; count is the capacity
  SendPlan* plan;
  SplatPlace* places;
  const std::int64_t* everyone;
  int n_views, n_ranks, rank;
  ScatterTargets targets;
};

namespace cuda {
// host: null, or pinned memory.
void device_barrier(const ControlWords&, std::int64_t number, const std::int64_t* values, int n_values,
                    std::int64_t first, double timeout_seconds, std::int64_t* host, Workspace&, CudaStream);
void send_splats(const SendArguments&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
