// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "active/view_gate.h"
#include "common/cuda.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kResident = 6;  // CUDA blocks that fit a multiprocessor of every supported GPU

// Applies the gate (view_gate.h) to the list, one thread per entry in a grid-stride loop.
__global__ void __launch_bounds__(kThreads, kResident) gate_views_kernel(const ViewGateArgs args) {
  __shared__ GateTable table;
  wait_for_earlier_kernels();
  const std::int64_t count = args.count ? *args.count : args.capacity;
  const std::int64_t first = blockIdx.x * std::int64_t{kThreads};
  if (first >= count) return;
  fill_gate_table(args.rules, args.viewmats, threadIdx.x, table);
  __syncthreads();
  for (std::int64_t i = first + threadIdx.x; i < count; i += std::int64_t{kThreads} * gridDim.x) {
    gate_entry(args, table, i);
  }
}

}  // namespace

void gate_views(const ViewGateArgs& args, Workspace&, CudaStream stream) {
  if (args.capacity == 0) return;
  // The grid is limited because the list's capacity is the whole table and its valid entries are few.
  const std::int64_t most = kResident * multiprocessors();
  const auto blocks =
      static_cast<unsigned>(std::min<std::int64_t>(blocks_for(args.capacity, kThreads), most));
  launch_early("gate_views", gate_views_kernel, {blocks, kThreads, stream}, args);
}

}  // namespace blitzgs::cuda
