// SPDX-License-Identifier: Apache-2.0
#include "peers/peers.h"

#include "common/cuda_check.h"
#include "tell_host/tell_host.h"

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

}  // namespace

void meet(const PeerMail& mail, std::int64_t meeting, const std::int64_t* values, int n_values,
          std::int64_t first, double timeout_seconds, std::int64_t* known, Workspace&, CudaStream stream) {
  const auto timeout = static_cast<std::uint64_t>(1e9 * timeout_seconds);
  meet_kernel<<<1, kMeetThreads, 0, stream>>>(mail, meeting, values, n_values, first, timeout,
                                              known ? device_address(known) : nullptr);
  check_launch("meet_peers");
}

}  // namespace blitzgs::cuda
