// SPDX-License-Identifier: Apache-2.0
// Compiled without FMA contraction (cmake/cuda.cmake): counting and emitting project the same row in two
// kernels, and must get the same bits.
#include <cub/device/device_scan.cuh>
#include <cub/warp/warp_reduce.cuh>

#include <algorithm>

#include "project/project_cull.cuh"
#include "project/project_plan.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kBatch = 4;  // candidates of a lane at a time
constexpr int kCountThreads = 128, kCountBlocks = 4096;

// The views that may see each of kBatch candidates first, first + 32, ..., from the mean, then the scale.
__device__ void quick_views(const Inputs& in, std::int64_t n_candidates, const Frustum* frusta,
                            std::int64_t first, std::uint32_t* maybe) {
  std::int64_t ids[kBatch];
  Vec3<float> means[kBatch];
  float norms[kBatch];
#pragma unroll
  for (int k = 0; k < kBatch; ++k) {
    const std::int64_t c = first + 32 * k;
    const bool present = c < n_candidates;
    ids[k] = present ? candidate_id(in, c) : 0;
    maybe[k] = !present ? 0u : in.active_views ? static_cast<std::uint32_t>(in.active_views[c]) : ~0u;
    if (in.n_views < 32) maybe[k] &= (1u << in.n_views) - 1u;
    means[k] = maybe[k] ? load3(in.means + 3 * ids[k]) : Vec3<float>{0.f, 0.f, 0.f};
    norms[k] = norm1(means[k]);
  }
  for (int view = 0; view < in.n_views; ++view) {
    const Frustum& frustum = frusta[view];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (!may_be_in_depth(frustum, means[k], norms[k])) maybe[k] &= ~(1u << view);
    }
  }
  float scales[kBatch];
#pragma unroll
  for (int k = 0; k < kBatch; ++k) scales[k] = maybe[k] ? largest_scale(in, ids[k]) : 0.f;
  for (int view = 0; view < in.n_views; ++view) {
    const Frustum& frustum = frusta[view];
#pragma unroll
    for (int k = 0; k < kBatch; ++k) {
      if (!may_overlap(frustum, means[k], norms[k], scales[k])) maybe[k] &= ~(1u << view);
    }
  }
}

// A block's sums for project_totals. Adding 64-bit numbers in shared memory is slow, so tiles carry by hand.
struct Sums {
  unsigned views[kMaxViews], rank_rows[kMaxRanks], tiles_low[kMaxRanks], tiles_high[kMaxRanks];
  unsigned long long visible, rows, tiles;

  __device__ void add_tiles(int rank, unsigned tiles) {
    const unsigned before = atomicAdd(&tiles_low[rank], tiles);
    if (before + tiles < before) atomicAdd(&tiles_high[rank], 1u);
  }
};

// The views that do see a candidate, of those that may.
__device__ std::uint32_t exact_views(const Inputs& in, const RankTiles& rank_tiles,
                                     const Camera<float>* cameras, std::int64_t candidate,
                                     std::uint32_t maybe, Sums* sums, std::int64_t* tiles) {
  const ActiveGaussian<float> gaussian = load_gaussian(in, candidate_id(in, candidate));
  std::uint32_t seen = 0;
  for (; maybe; maybe &= maybe - 1) {
    const int view = __ffs(maybe) - 1;
    Row<float> row{};
    if (!project_row(cameras[view], gaussian, in.options, &row)) continue;
    seen |= 1u << view;
    std::int64_t ranks;
    *tiles += row_tiles(row, view, in.options, rank_tiles, &ranks, [&](int rank, std::int64_t count) {
      sums->add_tiles(rank, static_cast<unsigned>(count));
    });
    for (; ranks; ranks &= ranks - 1) atomicAdd(&sums->rank_rows[__ffsll(ranks) - 1], 1u);
  }
  return seen;
}

// Adds a block's sums to the totals of the launch.
__device__ void store_sums(const Sums& sums, const Inputs& in, int n_ranks, unsigned long long* totals) {
  const int thread = threadIdx.x;
  if (thread == 0) {
    atomicAdd(totals + kTotalVisible, sums.visible);
    atomicAdd(totals + kTotalRows, sums.rows);
    atomicAdd(totals + kTotalTiles, sums.tiles);
  }
  if (thread < in.n_views && sums.views[thread]) {
    atomicAdd(totals + kTotalViews + thread, static_cast<unsigned long long>(sums.views[thread]));
  }
  if (thread < n_ranks && sums.rank_rows[thread]) {
    unsigned long long* target = totals + kTotalViews + in.n_views + 2 * thread;
    atomicAdd(target, static_cast<unsigned long long>(sums.rank_rows[thread]));
    atomicAdd(target + 1,
              static_cast<unsigned long long>(sums.tiles_high[thread]) << 32 | sums.tiles_low[thread]);
  }
}

// A warp takes a segment of candidates: the quick test of all, then the exact test of those it leaves. Warps
// never wait for one another, so some stream means while others work.
__global__ void __launch_bounds__(kCountThreads, 6)
    count_kernel(const Inputs in, const RankTiles rank_tiles, const NewPlan plan,
                 unsigned long long* totals) {
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ Frustum frusta[kMaxViews];
  __shared__ Sums sums;
  __shared__ std::uint32_t left_views[kCountThreads / 32][kMostSegment];
  __shared__ std::uint16_t left_slots[kCountThreads / 32][kMostSegment];
  const std::int64_t n_candidates = candidates_of(in), n_segments = segments_of(n_candidates);
  const int segment = segment_of(n_candidates);
  for (std::int64_t s = n_segments + blockIdx.x * std::int64_t{kCountThreads} + threadIdx.x;
       s <= most_segments(in.n_candidates); s += gridDim.x * std::int64_t{kCountThreads}) {
    plan.before[s] = 0;
  }
  if (blockIdx.x * std::int64_t{kCountThreads / 32} >= n_segments) return;
  for (int i = threadIdx.x; i < static_cast<int>(sizeof(Sums) / 4); i += kCountThreads) {
    reinterpret_cast<unsigned*>(&sums)[i] = 0;
  }
  load_cameras(in, cameras);
  __syncthreads();
  for (int view = threadIdx.x; view < in.n_views; view += kCountThreads)
    frusta[view] = make_frustum(cameras[view], in.options);
  __syncthreads();
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const unsigned below = (1u << lane) - 1u;
  std::uint32_t* const left = left_views[warp];
  std::uint16_t* const slots = left_slots[warp];
  std::int64_t tiles = 0, visible = 0, rows = 0;
  unsigned of_view = 0;  // rows of view `lane`
  for (std::int64_t s = blockIdx.x * (kCountThreads / 32) + warp; s < n_segments;
       s += static_cast<std::int64_t>(gridDim.x) * (kCountThreads / 32)) {
    int n_left = 0;
    for (int batch = 0; batch < segment; batch += 32 * kBatch) {
      std::uint32_t maybe[kBatch];
      quick_views(in, n_candidates, frusta, s * segment + batch + lane, maybe);
#pragma unroll
      for (int k = 0; k < kBatch; ++k) {
        const unsigned some = __ballot_sync(0xffffffffu, maybe[k] != 0);
        if (maybe[k]) {
          const int at = n_left + __popc(some & below);
          left[at] = maybe[k];
          slots[at] = static_cast<std::uint16_t>(batch + 32 * k + lane);
        }
        n_left += __popc(some);
      }
    }
    __syncwarp();
    int n_visible = 0;
    unsigned n_rows = 0;
    for (int first = 0; first < n_left; first += 32) {
      const bool present = first + lane < n_left;
      const std::uint16_t slot = present ? slots[first + lane] : 0;
      const std::uint32_t seen = present ? exact_views(in, rank_tiles, cameras, s * segment + slot,
                                                       left[first + lane], &sums, &tiles)
                                         : 0;
      const unsigned some = __ballot_sync(0xffffffffu, seen != 0);
      if (seen) {
        const std::int64_t at = s * segment + n_visible + __popc(some & below);
        plan.views[at] = seen;
        plan.slots[at] = slot;
      }
      n_visible += __popc(some);
      n_rows += __popc(seen);
      for (int view = 0; view < in.n_views; ++view) {
        const unsigned seeing = __ballot_sync(0xffffffffu, seen >> view & 1u);
        if (lane == view) of_view += __popc(seeing);
      }
    }
    __syncwarp();
    n_rows = __reduce_add_sync(0xffffffffu, n_rows);
    if (lane == 0) plan.before[s] = pack_counts(n_visible, n_rows);
    visible += n_visible;
    rows += n_rows;
  }
  if (of_view) atomicAdd(&sums.views[lane], of_view);
  using Reduce = cub::WarpReduce<std::int64_t>;
  __shared__ typename Reduce::TempStorage storage[kCountThreads / 32];
  tiles = Reduce(storage[warp]).Sum(tiles);
  if (lane == 0) {
    atomicAdd(&sums.tiles, static_cast<unsigned long long>(tiles));
    atomicAdd(&sums.visible, static_cast<unsigned long long>(visible));
    atomicAdd(&sums.rows, static_cast<unsigned long long>(rows));
  }
  __syncthreads();
  if (sums.rows > 0) store_sums(sums, in, rank_tiles.n_ranks, totals);
}

}  // namespace

std::size_t project_plan_bytes(std::int64_t candidates) {
  return static_cast<std::size_t>(most_segments(candidates) + 1) * sizeof(std::int64_t) +
         static_cast<std::size_t>(candidates) * (sizeof(std::uint32_t) + sizeof(std::uint16_t));
}

template <>
void project_count<float>(const Inputs& in, const RankTiles& rank_tiles, void* plan_memory, Workspace&,
                          std::int64_t* totals, Workspace& workspace, CudaStream stream) {
  const std::size_t bytes = project_totals(in.n_views, rank_tiles.n_ranks) * sizeof(std::int64_t);
  check(cudaMemsetAsync(totals, 0, bytes, stream), "project_count");
  const std::int64_t segments = most_segments(in.n_candidates);
  const NewPlan plan(plan_memory, in.n_candidates);
  if (segments == 0 || in.n_views == 0) return;
  const auto grid = std::min<std::int64_t>(kCountBlocks, blocks_for(segments, kCountThreads / 32));
  count_kernel<<<static_cast<unsigned>(grid), kCountThreads, 0, stream>>>(
      in, rank_tiles, plan, reinterpret_cast<unsigned long long*>(totals));
  check_launch("project_count");
  std::size_t scratch_bytes = 0;
  const auto scan = [&](void* scratch) {
    check(
        cub::DeviceScan::ExclusiveSum(scratch, scratch_bytes, plan.before, plan.before, segments + 1, stream),
        "project_count");
  };
  scan(nullptr);
  scan(workspace.allocate_bytes(scratch_bytes));
}

}  // namespace blitzgs::cuda
