// SPDX-License-Identifier: Apache-2.0
#include "peers/peers.h"

#include <algorithm>

#include "common/cuda_check.h"
#include "scatter/scatter_device.cuh"
#include "tell_host/tell_host.h"

namespace blitzgs::cuda {

namespace {

constexpr int kMeetThreads = 128;
// A block's threads and the words that each has on the way at once. `back` runs beside the projection's
// backward pass: with a third of a multiprocessor's registers its few blocks take the place of one of that
// kernel's each, and yet have enough on the way to fill the links.
constexpr int kReturnThreads = 512, kReturnAhead = 8, kReturnWords = kReturnThreads * kReturnAhead;
constexpr unsigned kReturnBlocks = 528, kReturnBlocksBack = 48;

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

// One block. A thread announces this rank to one peer and waits for that peer. Then, while nobody has to wait
// for a launch more, the values are added up and shown to the host.
__global__ void __launch_bounds__(kMeetThreads)
    meet_kernel(const PeerMail mail, std::int64_t meeting, const std::int64_t* values, int n_values,
                std::int64_t first, std::uint64_t timeout, std::int64_t* known) {
  for (int i = threadIdx.x; i < mail.count * n_values; i += kMeetThreads) {
    const int m = i / n_values, k = i - m * n_values;
    mail.of[m][first + mail.rank * n_values + k] = values[k];
  }
  __threadfence_system();
  __syncthreads();
  const int peer = threadIdx.x;
  if (peer < mail.count) {
    announce(mail.of[peer] + mail.rank, meeting);
    const std::uint64_t start = nanoseconds();
    while (look(mail.of[mail.rank] + peer) < meeting) {
      if (nanoseconds() - start > timeout) __trap();
    }
  }
  if (n_values == 0) return;
  __syncthreads();
  std::int64_t* brought = mail.of[mail.rank] + first;
  for (int k = threadIdx.x; k < n_values; k += kMeetThreads) {
    std::int64_t sum = 0;
    for (int m = 0; m < mail.count; ++m) {
      const std::int64_t value = brought[m * n_values + k];
      sum += value;
      if (known) known[m * n_values + k] = value;
    }
    brought[mail.count * n_values + k] = sum;
  }
}

// Block x: kReturnWords words at a time of the x-th of the other ranks' groups, from the first again after
// the last. Neighbouring blocks write to different ranks, so that no link waits for another.
template <int WIDTH>
__global__ void __launch_bounds__(kReturnThreads, 3) return_kernel(const __grid_constant__ PeerReturn job) {
  const int n_groups = job.groups.count - 1, width = WIDTH > 0 ? WIDTH : job.width;
  int m = static_cast<int>(blockIdx.x) % n_groups;
  if (m >= job.rank) ++m;
  const float* from = job.values + job.groups.start[m] * job.stride;
  float* to = job.targets[m];
  std::int64_t begin = 0, end = job.groups.size[m];
  if (job.fronts) {
    const std::int64_t front = min(max(job.fronts[m * job.fronts_stride], std::int64_t{0}), end);
    (job.back ? begin : end) = front;
  }
  begin *= width;
  end *= width;
  const int part = static_cast<int>(blockIdx.x) / n_groups, parts = static_cast<int>(gridDim.x) / n_groups;
  for (std::int64_t first =
           begin - words_past_line(to + begin) + part * std::int64_t{kReturnWords} + threadIdx.x;
       first < end; first += parts * std::int64_t{kReturnWords}) {
    float values[kReturnAhead];
#pragma unroll
    for (int k = 0; k < kReturnAhead; ++k) {
      const std::int64_t i = first + k * kReturnThreads;
      if (i < begin || i >= end) continue;
      const auto row = static_cast<std::int64_t>(static_cast<std::uint64_t>(i) / width);
      values[k] = from[row * job.stride + (i - row * width)];
    }
#pragma unroll
    for (int k = 0; k < kReturnAhead; ++k) {
      const std::int64_t i = first + k * kReturnThreads;
      if (i >= begin && i < end) to[i] = values[k];
    }
  }
}

}  // namespace

void meet(const PeerMail& mail, std::int64_t meeting, const std::int64_t* values, int n_values,
          std::int64_t first, double timeout_seconds, std::int64_t* known, Workspace&, CudaStream stream) {
  const auto timeout = static_cast<std::uint64_t>(1e9 * timeout_seconds);
  meet_kernel<<<1, kMeetThreads, 0, stream>>>(mail, meeting, values, n_values, first, timeout,
                                              known ? device_address(known) : nullptr);
  check_launch("meet_peers");
}

void return_rows(const PeerReturn& job, Workspace&, CudaStream stream) {
  const std::int64_t most = *std::max_element(job.groups.size, job.groups.size + job.groups.count);
  const unsigned groups = job.groups.count - 1, limit = job.back ? kReturnBlocksBack : kReturnBlocks;
  if (most == 0 || groups == 0) return;
  const unsigned blocks =
      groups * std::min(blocks_for(most * job.width, kReturnWords) + 1, blocks_for(limit, groups));
  const auto kernel = job.width == 9 ? return_kernel<9> : return_kernel<0>;
  kernel<<<blocks, kReturnThreads, 0, stream>>>(job);
  check_launch("return_to_peers");
}

}  // namespace blitzgs::cuda
