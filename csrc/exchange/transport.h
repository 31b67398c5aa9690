// SPDX-License-Identifier: Apache-2.0
// The exchange of splats between ranks that can access each other's memory (CUDA only). All ranks have
// buffers of the same shape; buffers[m] is the memory of rank m, mapped into this process.
//
// send_splats_ writes each splat to the buffers of the ranks in its rank mask. In each buffer the splats of
// this rank follow those of the ranks before it, and column c begins at word
// capacity * kSentColumns.begin[c]. If any rank has, sends or receives more than `capacity` splats, which all
// see in the totals, no rank writes any.
//
// For the way back, the owner of the splats sums their gradients, which it reads in the tables of the ranks
// that composited the splats (sum in scatter.h).
//
// device_barrier_ is a barrier in stream order: all work that any rank queued before its barrier is done, and
// its writes are visible, before work that any rank queues after its barrier runs. Each rank also sends its
// `values` to all others. control[m], int64: [M], the number of the last barrier that each rank reached; from
// word `first` on [M, n], the values of each rank, then [n], their sums. host [M, n], in pinned memory,
// receives the values for the host. A rank that waits for longer than timeout_seconds aborts with an error.
#pragma once
#include "exchange/scatter.h"
#include "project/project.h"

namespace blitzgs {

struct ControlWords {
  int64_t* of[kMaxPeers];
  int count, rank;
};

// The columns of a splat that other ranks need, with their offsets in words: means2d, conics, opacities,
// colors, depths, camera_ids and the Gaussian's persistent id.
inline constexpr SplatColumns<const int32_t> kSentColumns{{}, {0, 2, 5, 6, 9, 10, 11, 13}, 7};

// The numbers of splats that this rank sends and receives, in device memory.
struct SendPlan {
  int64_t received;           // splats that this rank receives; first, so that ops can read it as a number
  int64_t splats;             // splats of this rank
  SplatGroups groups;         // the splats for each rank, and the position of the first of them in its buffer
  int64_t filled[kMaxRanks];  // the number of positions for each rank that warps have taken
};

// everyone: project_totals of each rank, in device memory. targets: the addresses of the columns in each
// rank's buffer. plan and places are outputs.
struct SendArguments {
  ScatterSplats splats;  // the columns of kSentColumns; count is the capacity
  SendPlan* plan;
  SplatPlace* places;
  const int64_t* everyone;
  int n_views, n_ranks, rank;
  ScatterTargets targets;
};

namespace cuda {
// host: null, or pinned memory.
void device_barrier(const ControlWords&, int64_t number, const int64_t* values, int n_values, int64_t first,
                    double timeout_seconds, int64_t* host, CudaStream);
void send_splats(const SendArguments&, CudaStream);

// The address at which kernels of the current device access pinned memory of the host. Throws if the memory
// is not pinned. Kernels write numbers for the host there themselves: a cudaMemcpyAsync would be done by
// another engine of the GPU, and the stream would wait before and after it. The host waits, then reads.
int64_t* device_address(int64_t* pinned);
void copy_to_host(const int64_t* values, int64_t n, int64_t* host, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
