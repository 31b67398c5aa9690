// SPDX-License-Identifier: Apache-2.0
#include "peers/peers.h"

#include <algorithm>

#include "common/cuda_check.h"
#include "scatter/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kMeetThreads = 128, kReturnThreads = 256, kReturnWords = 2048;

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

// Block x: kReturnWords words of group x % M. Neighbouring blocks write to different ranks, so that no link
// waits for another.
template <int WIDTH>
__global__ void __launch_bounds__(kReturnThreads) return_kernel(const __grid_constant__ PeerReturn job) {
  const int m = static_cast<int>(blockIdx.x) % job.groups.count, width = WIDTH > 0 ? WIDTH : job.width;
  const float* from = job.values + job.groups.start[m] * job.stride;
  float* to = job.targets[m];
  const std::int64_t words = job.groups.size[m] * width;
  const std::int64_t first = static_cast<int>(blockIdx.x) / job.groups.count * std::int64_t{kReturnWords} -
                             words_past_line(to) + threadIdx.x;
#pragma unroll
  for (int k = 0; k < kReturnWords; k += kReturnThreads) {
    const std::int64_t i = first + k;
    if (i < 0 || i >= words) continue;
    const auto row = static_cast<std::int64_t>(static_cast<std::uint64_t>(i) / width);
    to[i] = from[row * job.stride + (i - row * width)];
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
  if (most == 0) return;
  const unsigned blocks = job.groups.count * (blocks_for(most * job.width, kReturnWords) + 1);
  const auto kernel = job.width == 9 ? return_kernel<9> : return_kernel<0>;
  kernel<<<blocks, kReturnThreads, 0, stream>>>(job);
  check_launch("return_to_peers");
}

}  // namespace blitzgs::cuda
