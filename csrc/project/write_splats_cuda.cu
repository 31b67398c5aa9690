// SPDX-License-Identifier: Apache-2.0
// Kernel 2 of the projection (project.h): projects the pairs of a Gaussian and a view that the prefilter
// kept, decides which of them are splats, and writes the splats in order. Compiled without FMA contraction
// (cmake/cuda.cmake), because a splat that is projected in two launches must get the same bits in both.

#include "project/project_device.cuh"

namespace blitzgs::cuda {
namespace {

constexpr int kWarps = kSplatThreads / 32, kBlocksPerMultiprocessor = 6;

// A block's contributions to project_totals. Atomic addition of 64-bit numbers in shared memory is slow, so
// the tiles of each rank are two 32-bit numbers with an explicit carry.
struct Sums {
  unsigned views[kMaxViews], rank_splats[kMaxRanks], tiles_low[kMaxRanks], tiles_high[kMaxRanks];
  unsigned long long visible, splats, tiles;

  __device__ void add_tiles(int rank, unsigned tiles) {
    const unsigned before = atomicAdd(&tiles_low[rank], tiles);
    if (before + tiles < before) atomicAdd(&tiles_high[rank], 1u);
  }
};

__device__ void store_sums(const Sums& sums, const Inputs& in, int n_ranks, unsigned long long* totals) {
  const int thread = threadIdx.x;
  if (thread == 0) {
    atomicAdd(totals + kTotalVisible, sums.visible);
    atomicAdd(totals + kTotalSplats, sums.splats);
    atomicAdd(totals + kTotalTiles, sums.tiles);
  }
  if (thread < in.n_views && sums.views[thread]) {
    atomicAdd(totals + kTotalViews + thread, static_cast<unsigned long long>(sums.views[thread]));
  }
  if (thread < n_ranks && sums.rank_splats[thread]) {
    unsigned long long* target = totals + kTotalViews + in.n_views + 2 * thread;
    atomicAdd(target, static_cast<unsigned long long>(sums.rank_splats[thread]));
    atomicAdd(target + 1,
              static_cast<unsigned long long>(sums.tiles_high[thread]) << 32 | sums.tiles_low[thread]);
  }
}

constexpr uint16_t kNoSplat = 0xffff;

// The splats of a turn in shared memory, by pair, until the block knows their positions in the output.
struct Pending {
  float2 means2d[kMaxPairs];
  float conics[3][kMaxPairs], depths[kMaxPairs], opacities[kMaxPairs];
  int2 radii[kMaxPairs];
  int32_t tiles[kMaxPairs];
  int64_t ranks[kMaxPairs];
  uint16_t pairs[kMaxPairs];  // kMaxViews * (slot in the group) + view; kNoSplat: not a splat
};

// Returns the number of tiles of a splat, sets *ranks to the ranks that composite some of them, and adds the
// splat and its tiles to the sums of these ranks.
__device__ __forceinline__ int32_t find_tiles(const Splat<float>& splat, int view, const Inputs& in,
                                              const RankTiles& rank_tiles, int64_t* ranks, Sums& sums) {
  int current = -1;            // the rank of the last pieces of tile rows
  unsigned tiles_of_rank = 0;  // tiles of these pieces: few splats have several ranks, so this saves atomics
  const int32_t tiles = splat_tiles(splat, view, in.options, rank_tiles, ranks, [&](int rank, int64_t count) {
    if (rank != current) {
      if (current >= 0) sums.add_tiles(current, tiles_of_rank);
      current = rank;
      tiles_of_rank = 0;
    }
    tiles_of_rank += unsigned(count);
  });
  if (current >= 0) sums.add_tiles(current, tiles_of_rank);
  for (int64_t rest = *ranks; rest; rest &= rest - 1) atomicAdd(&sums.rank_splats[__ffsll(rest) - 1], 1u);
  return tiles;
}

struct Group {
  uint32_t seen[kSplatThreads];  // the views in which each has a splat, as bits
  int32_t ids[kSplatThreads];
  int32_t before[kSplatThreads];  // of the Gaussians before it in the group: visible << 16 | splats
  int warp_sums[kWarps];
  int next_turn;
  int64_t before_turn;  // of all turns before: visible << 31 | splats
};

// Returns the sum of `value` over the threads before this one and sets *all to the sum over the block. It
// contains a barrier, and the caller needs another one between two calls.
__device__ __forceinline__ int sum_of_threads_before(int value, Group& group, int* all) {
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int until = sum_of_lanes_until(value, lane);
  if (lane == 31) group.warp_sums[warp] = until;
  __syncthreads();
  int before = until - value, total = 0;
#pragma unroll
  for (int other = 0; other < kWarps; ++other) {
    if (other < warp) before += group.warp_sums[other];
    total += group.warp_sums[other];
  }
  *all = total;
  return before;
}

// Writes the last entry of splat_offsets, the total number of splats. all: visible << 31 | splats.
__device__ __forceinline__ void end_splats(int64_t all, const ProjectSizes& capacity, const ProjectIds& ids) {
  const int64_t visible = all >> 31;
  if (capacity.splats > 0 && visible <= capacity.visible) {
    ids.splat_offsets[visible] = int32_t(all & 0x7fffffff);
  }
}

// Writes the visible Gaussians and splats of a group, up to the capacity. before: visible << 31 | splats of
// all turns before.
__device__ __forceinline__ void write_splats(const Group& group, int64_t before, const Pending& pending,
                                             int n_pairs, const ProjectSizes& capacity, const ProjectIds& ids,
                                             const ProjectOutputs<float>& out) {
  const int thread = threadIdx.x;
  const int64_t visible_before = before >> 31, splats_before = before & 0x7fffffff;
  const int32_t in_group = group.before[thread];
  const int64_t u = visible_before + (in_group >> 16);
  if (group.seen[thread] && u < capacity.visible) {
    ids.visible_ids[u] = group.ids[thread];
    ids.splat_offsets[u] = int32_t(splats_before + (in_group & 0xffff));
  }
  for (int p = thread; p < n_pairs; p += kSplatThreads) {
    const int pair = pending.pairs[p], slot = pair / kMaxViews, view = pair % kMaxViews;
    if (pair == kNoSplat) continue;
    const uint32_t views_of_slot = group.seen[slot];
    const int64_t i =
        splats_before + (group.before[slot] & 0xffff) + __popc(views_of_slot & ((1u << view) - 1u));
    if (i >= capacity.splats) continue;
    ids.gaussian_ids[i] = group.ids[slot];
    ids.camera_ids[i] = view;
    reinterpret_cast<float2*>(out.means2d)[i] = pending.means2d[p];
    for (int k = 0; k < 3; ++k) out.conics[3 * i + k] = pending.conics[k][p];
    out.depths[i] = pending.depths[p];
    out.opacities[i] = pending.opacities[p];
    reinterpret_cast<int2*>(out.radii)[i] = pending.radii[p];
    out.tiles_touched[i] = pending.tiles[p];
    if (out.rank_masks) out.rank_masks[i] = pending.ranks[p];
    if (out.splat_ids) out.splat_ids[i] = out.ids[group.ids[slot]];
  }
}

// Projects the Gaussians that the prefilter kept (docs/image.md, sections 1 and 2) and writes their splats
// (ProjectIds, ProjectOutputs without colours) and the totals. A block takes Gaussians turn by turn, one per
// thread, and writes their splats after those of all turns before. To count the tiles of their splats takes
// some blocks much longer than others, so a block first publishes the number of its splats, then counts the
// tiles, and only then reads the number of splats of the turns before.
__global__ void __launch_bounds__(kSplatThreads, kBlocksPerMultiprocessor)
    splats_kernel(const __grid_constant__ Inputs in, const __grid_constant__ RankTiles rank_tiles,
                  const Prefiltered kept, const ProjectSizes capacity, const ProjectIds ids,
                  const ProjectOutputs<float> out, unsigned long long* totals, const TurnSums turns) {
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ TripleStage triples[kWarps];
  __shared__ Sums sums;
  __shared__ Group group;
  __shared__ Pending pending;
  const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
  const int64_t n_gaussians = *kept.count;
  const int at_once = projected_at_once(in.n_views);
  const int n_turns = int((n_gaussians + at_once - 1) / at_once);
  if (blockIdx.x == 0 && thread == 0) {
    if (n_turns == 0) end_splats(0, capacity, ids);
    if (totals && in.n_blocks) totals[kTotalBlocks] = *in.n_blocks;
  }
  if (int(blockIdx.x) > n_turns) return;
  const bool writes = capacity.splats > 0;
  for (int i = thread; i < int(sizeof(Sums) / 4); i += kSplatThreads) {
    reinterpret_cast<unsigned*>(&sums)[i] = 0;
  }
  load_cameras(in, cameras);
  int64_t tiles = 0;
  unsigned splats_of_view = 0;  // splats of this warp in view number `lane`
  int turn = turns.first();
  if (turn < 0) {
    if (warp == 0 && writes) turns.add_up(n_turns);
    return;
  }
  for (; turn < n_turns; turn = group.next_turn) {
    const int64_t first = turn * int64_t{at_once};
    uint32_t maybe = 0;
    int32_t id = -1;
    if (thread < at_once && first + thread < n_gaussians) {
      maybe = kept.views[first + thread];
      id = kept.ids[first + thread];
    }
    int n_pairs, p = sum_of_threads_before(__popc(maybe), group, &n_pairs);
    const Vec3<float> mean = triples[warp].gather(in.means, id, lane),
                      scale = triples[warp].gather(in.scales, id, lane);
    uint32_t seen = 0;
    if (maybe) {
      const ActivatedGaussian<float> gaussian = make_gaussian(in, id, mean, scale);
      for (; maybe; maybe &= maybe - 1, ++p) {
        const int view = __ffs(maybe) - 1;
        Splat<float> splat{};
        pending.pairs[p] = kNoSplat;
        if (!project_splat(cameras[view], gaussian, in.options, &splat)) continue;
        seen |= 1u << view;
        pending.pairs[p] = uint16_t(kMaxViews * thread + view);
        pending.means2d[p] = {splat.mean2d[0], splat.mean2d[1]};
        for (int k = 0; k < 3; ++k) pending.conics[k][p] = splat.conic[k];
        pending.depths[p] = splat.depth;
        pending.opacities[p] = splat.opacity;
        pending.radii[p] = {pixel_radius(splat.extent[0]), pixel_radius(splat.extent[1])};
      }
    }
    for (int view = 0; view < in.n_views; ++view) {
      const unsigned seeing = __ballot_sync(kFullWarp, seen >> view & 1u);
      if (lane == view) splats_of_view += __popc(seeing);
    }
    group.seen[thread] = seen;
    group.ids[thread] = id;
    __syncthreads();
    int group_sums;
    group.before[thread] = sum_of_threads_before((seen != 0) << 16 | __popc(seen), group, &group_sums);
    const int64_t turn_sums = int64_t{group_sums >> 16} << 31 | (group_sums & 0xffff);
    if (thread == 0) {
      if (writes) turns.publish(turn, turn_sums);
      sums.visible += group_sums >> 16;
      sums.splats += group_sums & 0xffff;
    }
    for (p = thread; p < n_pairs; p += kSplatThreads) {
      const int pair = pending.pairs[p];
      if (pair == kNoSplat) continue;
      const float2 mean2d = pending.means2d[p];
      const Splat<float> splat{{mean2d.x, mean2d.y},
                               {pending.conics[0][p], pending.conics[1][p], pending.conics[2][p]},
                               pending.depths[p],
                               pending.opacities[p],
                               {}};
      pending.tiles[p] = find_tiles(splat, pair % kMaxViews, in, rank_tiles, &pending.ranks[p], sums);
      tiles += pending.tiles[p];
    }
    int next = 0;
    if (thread == 0) {
      if (writes) group.before_turn = turns.before(turn);
      // The block takes its next turn only here, because other blocks wait until the taken turn is published.
      next = turns.next();
    }
    __syncthreads();
    if (writes) {
      const int64_t before = group.before_turn;
      write_splats(group, before, pending, n_pairs, capacity, ids, out);
      if (turn == n_turns - 1 && thread == 0) end_splats(before + turn_sums, capacity, ids);
    }
    if (thread == 0) group.next_turn = next;
    __syncthreads();
  }
  if (!totals) return;
  if (splats_of_view) atomicAdd(&sums.views[lane], splats_of_view);
  for (int step = 16; step > 0; step /= 2) tiles += __shfl_xor_sync(kFullWarp, tiles, step);
  if (lane == 0) atomicAdd(&sums.tiles, static_cast<unsigned long long>(tiles));
  __syncthreads();
  if (sums.splats > 0) store_sums(sums, in, rank_tiles.n_ranks, totals);
}

}  // namespace

void write_splats(const Inputs& in, const RankTiles& rank_tiles, const Prefiltered& kept,
                  const ProjectSizes& capacity, const ProjectColumns<float>& columns, int64_t* totals,
                  Workspace& workspace, CudaStream stream) {
  const ProjectIds& ids = columns.ids;
  if (totals) {
    const size_t bytes = project_totals(in.n_views, rank_tiles.n_ranks) * sizeof(int64_t);
    check(cudaMemsetAsync(totals, 0, bytes, stream), "project");
  }
  if (capacity.splats == 0 && ids.splat_offsets) {
    check(cudaMemsetAsync(ids.splat_offsets, 0, sizeof(*ids.splat_offsets), stream), "project");
    if (!totals) return;
  }
  const int at_once = projected_at_once(in.n_views);
  const int64_t turns = std::max<int64_t>(1, (in.n_candidates + at_once - 1) / at_once);
  splats_kernel<<<resident_blocks(1 + turns, 1, kBlocksPerMultiprocessor), kSplatThreads, 0, stream>>>(
      in, rank_tiles, kept, capacity, ids, columns.values, reinterpret_cast<unsigned long long*>(totals),
      TurnSums(turn_zeros(turns, workspace, stream)));
  check_launch("project");
}

}  // namespace blitzgs::cuda
