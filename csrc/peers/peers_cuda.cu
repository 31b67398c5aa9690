// SPDX-License-Identifier: Apache-2.0
#include "peers/peers.h"

#include <algorithm>

#include "common/cuda_check.h"
#include "scatter/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kMeetThreads = 128;

__device__ std::uint64_t nanoseconds() {
  std::uint64_t now;
  asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(now));
  return now;
}

__device__ void announce(std::int64_t* flag, std::int64_t meeting) {
  asm volatile("st.release.sys.global.s64 [%0], %1;" ::"l"(flag), "l"(meeting) : "memory");
}

__device__ std::int64_t look(const std::int64_t* flag) {
  std::int64_t meeting;
  asm volatile("ld.acquire.sys.global.s64 %0, [%1];" : "=l"(meeting) : "l"(flag) : "memory");
  return meeting;
}

// One block. A thread announces this rank to one peer and waits for that peer.
__global__ void __launch_bounds__(kMeetThreads)
    meet_kernel(const PeerMail mail, std::int64_t meeting, const std::int64_t* values, int n_values,
                std::uint64_t timeout) {
  for (int i = threadIdx.x; i < mail.count * n_values; i += kMeetThreads) {
    const int m = i / n_values, k = i - m * n_values;
    mail.of[m][mail.count + mail.rank * n_values + k] = values[k];
  }
  __threadfence_system();
  __syncthreads();
  const int peer = threadIdx.x;
  if (peer >= mail.count) return;
  announce(mail.of[peer] + mail.rank, meeting);
  const std::uint64_t start = nanoseconds();
  while (look(mail.of[mail.rank] + peer) < meeting) {
    if (nanoseconds() - start > timeout) __trap();
  }
}

// Block x: kScatterBlock rows of group x % M, put together in shared memory, leave in one run. Neighbouring
// blocks write to different ranks, so that no link waits for another.
__global__ void __launch_bounds__(kScatterBlock) return_kernel(const __grid_constant__ PeerReturn job) {
  extern __shared__ float block_rows[];
  const int m = static_cast<int>(blockIdx.x) % job.groups.count;
  const int width = job.columns.begin[job.columns.count];
  const std::int64_t first = static_cast<int>(blockIdx.x) / job.groups.count * std::int64_t{kScatterBlock};
  const std::int64_t left = job.groups.size[m] - first;
  if (left <= 0) return;
  const int n_rows = left < kScatterBlock ? static_cast<int>(left) : kScatterBlock;
  for (int c = 0; c < job.columns.count; ++c) {
    const int begin = job.columns.begin[c], part = job.columns.begin[c + 1] - begin;
    const float* from = job.columns.data[c] + (job.groups.start[m] + first) * part;
    for (int i = threadIdx.x; i < n_rows * part; i += kScatterBlock) {
      const int row = i / part;
      block_rows[row * width + begin + (i - row * part)] = from[i];
    }
  }
  __syncthreads();
  float* to = job.targets[m] + first * width;
  for (int i = static_cast<int>(threadIdx.x) - words_past_line(to); i < n_rows * width; i += kScatterBlock) {
    if (i >= 0) to[i] = block_rows[i];
  }
}

}  // namespace

void meet(const PeerMail& mail, std::int64_t meeting, const std::int64_t* values, int n_values,
          double timeout_seconds, Workspace&, CudaStream stream) {
  const auto timeout = static_cast<std::uint64_t>(1e9 * timeout_seconds);
  meet_kernel<<<1, kMeetThreads, 0, stream>>>(mail, meeting, values, n_values, timeout);
  check_launch("meet_peers");
}

void return_rows(const PeerReturn& job, Workspace&, CudaStream stream) {
  const std::int64_t most = *std::max_element(job.groups.size, job.groups.size + job.groups.count);
  const std::size_t bytes = kScatterBlock * job.columns.begin[job.columns.count] * sizeof(float);
  if (most == 0 || bytes == 0) return;
  if (bytes > 48 * 1024) {
    check(cudaFuncSetAttribute(return_kernel, cudaFuncAttributeMaxDynamicSharedMemorySize,
                               static_cast<int>(bytes)),
          "return_to_peers");
  }
  const std::int64_t blocks = scatter_blocks(most) * job.groups.count;
  return_kernel<<<static_cast<unsigned>(blocks), kScatterBlock, bytes, stream>>>(job);
  check_launch("return_to_peers");
}

}  // namespace blitzgs::cuda
