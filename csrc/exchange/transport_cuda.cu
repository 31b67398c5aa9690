// SPDX-License-Identifier: Apache-2.0
#include "exchange/scatter_device.cuh"
#include "exchange/transport.h"

namespace blitzgs::cuda {
namespace {

constexpr int kThreads = 128;

// host [n] = values [n], one thread per value.
__global__ void copy_kernel(const int64_t* values, int64_t n, int64_t* host) {
  wait_for_earlier_kernels();
  const int64_t i = blockIdx.x * int64_t{kThreads} + threadIdx.x;
  if (i < n) host[i] = values[i];
}

constexpr int kBarrierThreads = 128;

__device__ uint64_t nanoseconds() {
  uint64_t now;
  asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
  return now;
}

__device__ void announce(int64_t* flag, int64_t number) {
  asm volatile("st.release.sys.global.s64 [%0], %1;" ::"l"(flag), "l"(number) : "memory");
}

__device__ int64_t look(const int64_t* flag) {
  int64_t number;
  asm volatile("ld.acquire.sys.global.s64 %0, [%1];" : "=l"(number) : "l"(flag) : "memory");
  return number;
}

// The device barrier (transport.h), one block. It first writes this rank's values to all peers. Thread m then
// tells peer m that this rank has arrived, and waits until peer m has. At last the block sums the values of
// all ranks and writes them to the host's memory, which saves a launch.
__global__ void __launch_bounds__(kBarrierThreads)
    barrier_kernel(const ControlWords control, int64_t number, const int64_t* values, int n_values,
                   int64_t first, uint64_t timeout, int64_t* host) {
  for (int i = threadIdx.x; i < control.count * n_values; i += kBarrierThreads) {
    const int m = i / n_values, k = i - m * n_values;
    control.of[m][first + control.rank * n_values + k] = values[k];
  }
  __threadfence_system();
  __syncthreads();
  const int peer = threadIdx.x;
  if (peer < control.count) {
    announce(control.of[peer] + control.rank, number);
    const uint64_t start = nanoseconds();
    while (look(control.of[control.rank] + peer) < number) {
      if (nanoseconds() - start > timeout) __trap();
    }
  }
  if (n_values == 0) return;
  __syncthreads();
  int64_t* brought = control.of[control.rank] + first;
  for (int k = threadIdx.x; k < n_values; k += kBarrierThreads) {
    int64_t sum = 0;
    for (int m = 0; m < control.count; ++m) {
      const int64_t value = brought[m * n_values + k];
      sum += value;
      if (host) host[m * n_values + k] = value;
    }
    brought[control.count * n_values + k] = sum;
  }
}

constexpr int kSendBlocks = 2;  // blocks per multiprocessor: enough to fill the links
constexpr int kSendPlaces = 6;  // blocks per multiprocessor for which the compiler limits the registers

// Computes the SendPlan from the totals of all ranks: one warp, one lane per rank. If the splats of any rank
// exceed a capacity, this rank sends none.
__global__ void plan_kernel(const __grid_constant__ SendArguments args) {
  const int m = threadIdx.x, n_ranks = args.n_ranks;
  const int64_t stride = project_totals(args.n_views, n_ranks), capacity = args.splats.count;
  const auto splats = [&](int source, int target) {
    return args.everyone[source * stride + kTotalViews + args.n_views + 2 * target];
  };
  SendPlan* const out = args.plan;
  int64_t own = 0, sent = 0, received = 0, start = 0;
  if (m < n_ranks) {
    own = args.everyone[m * stride + kTotalSplats];
    for (int other = 0; other < n_ranks; ++other) {
      if (other == args.rank) start = received;
      sent += splats(m, other);
      received += splats(other, m);
    }
    out->groups.size[m] = splats(args.rank, m);
    out->groups.start[m] = start;
    out->filled[m] = 0;
  }
  const bool fits = __all_sync(kFullWarp, max(own, max(sent, received)) <= capacity);
  const int64_t own_here = __shfl_sync(kFullWarp, own, args.rank),
                received_here = __shfl_sync(kFullWarp, received, args.rank);
  if (m > 0) return;
  out->splats = fits ? own_here : 0;
  out->received = fits ? received_here : 0;
  out->groups.count = n_ranks;
}

// The jobs of send_kernel. A job is a block of kScatterBlock splats and a rank: the block's splats for this
// rank become one run of the rank's columns (scatter_device.cuh). One warp does a job. Warps do not wait for
// each other, so that the links are always busy.
struct Jobs {
  int64_t first, step, end;
  int n_ranks;

  __device__ Jobs(int64_t n_splats, int n_ranks_in)
      : first(blockIdx.x * int64_t{kScatterWarps} + threadIdx.x / 32),
        step(gridDim.x * int64_t{kScatterWarps}),
        end((n_splats + kScatterBlock - 1) / kScatterBlock * n_ranks_in),
        n_ranks(n_ranks_in) {}
  __device__ int rank(int64_t job) const { return int(job % n_ranks); }
  __device__ int64_t splat(int64_t job) const { return job / n_ranks * kScatterBlock; }
};

// How many of a run's `count` splats from position `first` on fit a group of `size` splats.
__device__ int fitting_splats(int count, int64_t size, int64_t first) {
  return int(min(max(size - first, int64_t{0}), int64_t{count}));
}

// Writes the splats to the ranks of their masks, and the places [runs, M]. A warp per job, in a loop.
__global__ void __launch_bounds__(kScatterBlock, kSendPlaces)
    send_kernel(const __grid_constant__ ScatterSplats splats, const __grid_constant__ ScatterTargets targets,
                const SendPlan* __restrict__ plan, const ScatterState state, int n_ranks) {
  __shared__ uint8_t lists[kScatterWarps][kScatterBlock];
  const int lane = threadIdx.x % 32;
  const int64_t n_splats = plan->splats;
  const SplatGroups& groups = plan->groups;
  const SplatColumns<const int32_t>& columns = splats.columns;
  uint8_t* const list = lists[threadIdx.x / 32];
  const Jobs jobs(n_splats, n_ranks);
  for (int64_t job = jobs.first; job < jobs.end; job += jobs.step) {
    const int m = jobs.rank(job);
    const int64_t begin = jobs.splat(job);
    uint32_t masks[kScatterWarps];  // kMaxPeers bits are enough
#pragma unroll
    for (int run = 0; run < kScatterWarps; ++run) {
      const int64_t splat = begin + kPlaceSplats * run + lane;
      masks[run] = splat < n_splats ? uint32_t(splats.masks[splat]) : 0;
    }
    int count = 0;
    SplatPlace place{0, 0};  // the place of run number `lane`
#pragma unroll
    for (int run = 0; run < kScatterWarps; ++run) {
      const bool goes = masks[run] >> m & 1;
      const uint32_t bits = __ballot_sync(kFullWarp, goes);
      if (goes) list[count + __popc(bits & ((1u << lane) - 1u))] = uint8_t(kPlaceSplats * run + lane);
      if (lane == run) place = {count, bits};
      count += __popc(bits);
    }
    int32_t first = 0;
    if (lane == 0) first = int32_t(state.take(m, count));
    first = __shfl_sync(kFullWarp, first, 0);
    __syncwarp();
    if (lane < kScatterWarps && begin + kPlaceSplats * lane < n_splats) {
      state.places[(begin / kPlaceSplats + lane) * n_ranks + m] = {first + place.first, place.bits};
    }
    const int n = fitting_splats(count, groups.size[m], first);
    const int64_t to = groups.start[m] + first;
    for (int c = 0; c < columns.count; ++c) {
      const int width = columns.begin[c + 1] - columns.begin[c];
      copy_run(columns.data[c] + begin * width, list, n, width, targets.words[m][c] + to * width);
    }
    __syncwarp();
  }
}

}  // namespace

int64_t* device_address(int64_t* pinned) {
  cudaPointerAttributes found{};
  check(cudaPointerGetAttributes(&found, pinned), "pinned memory");
  if (found.type != cudaMemoryTypeHost || !found.devicePointer) {
    throw std::runtime_error("blitzgs: what the GPU is to write for the host must be pinned memory");
  }
  return static_cast<int64_t*>(found.devicePointer);
}

void copy_to_host(const int64_t* values, int64_t n, int64_t* host, CudaStream stream) {
  if (n == 0) return;
  launch_early("copy_to_host", copy_kernel, {blocks_for(n, kThreads), kThreads, stream}, values, n,
               device_address(host));
}

void device_barrier(const ControlWords& control, int64_t number, const int64_t* values, int n_values,
                    int64_t first, double timeout_seconds, int64_t* host, CudaStream stream) {
  const auto timeout = uint64_t(1e9 * timeout_seconds);
  barrier_kernel<<<1, kBarrierThreads, 0, stream>>>(control, number, values, n_values, first, timeout,
                                                    host ? device_address(host) : nullptr);
  check_launch("device_barrier");
}

void send_splats(const SendArguments& args, CudaStream stream) {
  plan_kernel<<<1, 32, 0, stream>>>(args);
  check_launch("send_splats");
  if (args.splats.count == 0) return;
  send_kernel<<<resident_blocks(args.splats.count, kScatterBlock, kSendBlocks), kScatterBlock, 0, stream>>>(
      args.splats, args.targets, args.plan, {args.plan->filled, args.places}, args.n_ranks);
  check_launch("send_splats");
}

}  // namespace blitzgs::cuda
