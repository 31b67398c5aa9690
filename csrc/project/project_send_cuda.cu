// SPDX-License-Identifier: Apache-2.0
// Rows to the ranks that composite them, straight into these ranks' memory.
#include <algorithm>
#include <iterator>

#include "common/multiprocessors.h"
#include "peers/peers.h"
#include "project/project_plan.cuh"
#include "scatter/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

// Blocks of a multiprocessor: enough to fill the links, and few enough that what computes has its place.
constexpr int kSendBlocks = 2, kColorSendBlocks = 2;
constexpr int kSendPlaces = 6;  // with as many registers as if there were so many

// One warp, a lane a rank. Rows that do not fit, here or at some rank, are not admitted.
__global__ void admit_kernel(const __grid_constant__ ProjectScatter scatter, int n_views) {
  const int m = threadIdx.x, n_ranks = scatter.n_ranks;
  const std::int64_t stride = kTotalViews + n_views + 2 * n_ranks;
  const auto rows = [&](int source, int target) {
    return scatter.everyone[source * stride + kTotalViews + n_views + 2 * target];
  };
  ProjectAdmitted* const out = scatter.admitted;
  std::int64_t own = 0, sent = 0, received = 0, start = 0;
  if (m < n_ranks) {
    own = scatter.everyone[m * stride + kTotalRows];
    for (int other = 0; other < n_ranks; ++other) {
      if (other == scatter.rank) start = received;
      sent += rows(m, other);
      received += rows(other, m);
    }
    out->groups.size[m] = rows(scatter.rank, m);
    out->groups.start[m] = start;
    out->filled[m] = 0;
  }
  const bool admitted = __all_sync(kFullWarp, max(own, max(sent, received)) <= scatter.capacity);
  const std::int64_t received_here = __shfl_sync(kFullWarp, received, scatter.rank);
  if (m > 0) return;
  const std::int64_t* totals = scatter.everyone + scatter.rank * stride;
  out->sizes = admitted ? ProjectSizes{totals[kTotalVisible], totals[kTotalRows]} : ProjectSizes{0, 0};
  out->received = admitted ? received_here : 0;
  out->groups.count = n_ranks;
}

// Warps take a block of rows and a rank at a time: the rows of the one for the other are one run of the
// rank's columns (scatter_device.cuh). No warp waits for another, so that the links always have something to
// do.
struct Jobs {
  std::int64_t first, step, end;
  int n_ranks;

  __device__ Jobs(std::int64_t n_rows, int n_ranks_in)
      : first(blockIdx.x * std::int64_t{kScatterWarps} + threadIdx.x / 32),
        step(gridDim.x * std::int64_t{kScatterWarps}),
        end((n_rows + kScatterBlock - 1) / kScatterBlock * n_ranks_in),
        n_ranks(n_ranks_in) {}
  __device__ int rank(std::int64_t job) const { return static_cast<int>(job % n_ranks); }
  __device__ std::int64_t row(std::int64_t job) const { return job / n_ranks * kScatterBlock; }
};

// How many of a run, which begins at place `first` of a group of `size`, the group has room for.
__device__ int fitting_rows(int count, std::int64_t size, std::int64_t first) {
  return static_cast<int>(min(max(size - first, std::int64_t{0}), std::int64_t{count}));
}

__global__ void __launch_bounds__(kScatterBlock, kSendPlaces)
    send_kernel(const __grid_constant__ ScatterRows rows, const __grid_constant__ ScatterTargets targets,
                const ProjectAdmitted* __restrict__ admitted, const ScatterState state, int n_ranks) {
  __shared__ std::uint8_t lists[kScatterWarps][kScatterBlock];
  const int lane = threadIdx.x % 32;
  const std::int64_t n_rows = admitted->sizes.rows;
  const RowGroups& groups = admitted->groups;
  const RowColumns<const std::int32_t>& columns = rows.columns;
  std::uint8_t* const list = lists[threadIdx.x / 32];
  const Jobs jobs(n_rows, n_ranks);
  for (std::int64_t job = jobs.first; job < jobs.end; job += jobs.step) {
    const int m = jobs.rank(job);
    const std::int64_t begin = jobs.row(job);
    std::uint32_t masks[kScatterWarps];  // kMaxPeers bits are enough
#pragma unroll
    for (int run = 0; run < kScatterWarps; ++run) {
      const std::int64_t row = begin + kPlaceRows * run + lane;
      masks[run] = row < n_rows ? static_cast<std::uint32_t>(rows.masks[row]) : 0;
    }
    int count = 0;
    RowPlace place{0, 0};  // of run `lane`
#pragma unroll
    for (int run = 0; run < kScatterWarps; ++run) {
      const bool goes = masks[run] >> m & 1;
      const std::uint32_t bits = __ballot_sync(kFullWarp, goes);
      if (goes) {
        list[count + __popc(bits & ((1u << lane) - 1u))] = static_cast<std::uint8_t>(kPlaceRows * run + lane);
      }
      if (lane == run) place = {count, bits};
      count += __popc(bits);
    }
    std::int32_t first = 0;
    if (lane == 0) {
      first = static_cast<std::int32_t>(state.take(m, count));
    }
    first = __shfl_sync(kFullWarp, first, 0);
    __syncwarp();
    if (lane < kScatterWarps && begin + kPlaceRows * lane < n_rows) {
      state.places[(begin / kPlaceRows + lane) * n_ranks + m] = {first + place.first, place.bits};
    }
    const int n = fitting_rows(count, groups.size[m], first);
    const std::int64_t to = groups.start[m] + first;
    for (int c = 0; c < columns.count; ++c) {
      const int width = columns.begin[c + 1] - columns.begin[c];
      copy_run(columns.data[c] + begin * width, list, n, width, targets.words[m][c] + to * width);
    }
    __syncwarp();
  }
}

__global__ void __launch_bounds__(kScatterBlock)
    send_colors_kernel(const std::int32_t* __restrict__ colors, const float* __restrict__ opacities,
                       const RowPlace* __restrict__ places, const __grid_constant__ ScatterTargets targets,
                       const ProjectAdmitted* __restrict__ admitted) {
  __shared__ std::uint8_t lists[kScatterWarps][kScatterBlock];
  const int lane = threadIdx.x % 32, n_ranks = admitted->groups.count;
  const std::int64_t n_rows = admitted->sizes.rows;
  std::uint8_t* const list = lists[threadIdx.x / 32];
  const Jobs jobs(n_rows, n_ranks);
  for (std::int64_t job = jobs.first; job < jobs.end; job += jobs.step) {
    const int m = jobs.rank(job);
    const std::int64_t begin = jobs.row(job);
    RowPlace place{0, 0};  // of run `lane`
    if (lane < kScatterWarps && begin + kPlaceRows * lane < n_rows) {
      place = places[(begin / kPlaceRows + lane) * n_ranks + m];
    }
    float shown[kScatterWarps];
#pragma unroll
    for (int run = 0; run < kScatterWarps; ++run) {
      const std::int64_t row = begin + kPlaceRows * run + lane;
      shown[run] = row < n_rows ? opacities[row] : 0.f;
    }
    const std::int32_t first = __shfl_sync(kFullWarp, place.first, 0);
    const std::int64_t to = admitted->groups.start[m] + first, size = admitted->groups.size[m];
    int count = 0;
#pragma unroll
    for (int run = 0; run < kScatterWarps; ++run) {
      const std::uint32_t bits = __shfl_sync(kFullWarp, place.bits, run);
      const int at = count + __popc(bits & ((1u << lane) - 1u));
      if (bits >> lane & 1u) {
        list[at] = static_cast<std::uint8_t>(kPlaceRows * run + lane);
        if (shown[run] == 0.f && first + at < size) targets.words[m][kOpacityColumn][to + at] = 0;
      }
      count += __popc(bits);
    }
    __syncwarp();
    copy_run<3>(colors + 3 * begin, list, fitting_rows(count, size, first), 3,
                targets.words[m][kColorColumn] + 3 * to);
    __syncwarp();
  }
}

unsigned blocks_beside(std::int64_t rows, int of_multiprocessor) {
  return static_cast<unsigned>(
      std::min<std::int64_t>(scatter_blocks(rows), of_multiprocessor * multiprocessors()));
}

const std::int32_t* words(const void* column) { return static_cast<const std::int32_t*>(column); }

}  // namespace

void project_rows_to_ranks(const ProjectIds& ids, const ProjectOutputs<float>& out, int n_views,
                           const ProjectScatter& scatter, CudaStream stream) {
  admit_kernel<<<1, 32, 0, stream>>>(scatter, n_views);
  check_launch("project_send");
  if (scatter.capacity == 0) return;
  const std::int32_t* data[] = {words(out.means2d), words(out.conics), words(out.opacities),
                                words(out.colors),  words(out.depths), ids.camera_ids,
                                words(out.row_ids)};
  static_assert(std::size(data) == kEmittedColumns.count);
  RowColumns<const std::int32_t> columns{};
  ScatterTargets targets{};
  for (int c = 0; c < kEmittedColumns.count; ++c) {
    if (c == kColorColumn && !scatter.with_colors) continue;
    const int to = columns.count++;
    columns.data[to] = data[c];
    columns.begin[to + 1] = columns.begin[to] + kEmittedColumns.begin[c + 1] - kEmittedColumns.begin[c];
    for (int m = 0; m < scatter.n_ranks; ++m) targets.words[m][to] = scatter.targets.words[m][c];
  }
  send_kernel<<<blocks_beside(scatter.capacity, kSendBlocks), kScatterBlock, 0, stream>>>(
      {columns, out.rank_masks, scatter.capacity}, targets, scatter.admitted,
      {scatter.admitted->filled, scatter.places}, scatter.n_ranks);
  check_launch("project_send");
}

void project_colors_to_ranks(const ProjectOutputs<float>& out, const ProjectScatter& scatter,
                             CudaStream stream) {
  if (scatter.capacity == 0) return;
  send_colors_kernel<<<blocks_beside(scatter.capacity, kColorSendBlocks), kScatterBlock, 0, stream>>>(
      words(out.colors), out.opacities, scatter.places, scatter.targets, scatter.admitted);
  check_launch("project_send");
}

}  // namespace blitzgs::cuda
