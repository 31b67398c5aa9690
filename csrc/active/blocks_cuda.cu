// SPDX-License-Identifier: Apache-2.0
#include "active/blocks.h"
#include "active/view_gate.h"
#include "common/cuda.cuh"
#include "math/morton.h"

namespace blitzgs::cuda {
namespace {

constexpr int kWarps = kBlockRows / 32;
// A group: the blocks that a CUDA block tests with a thread each, by which prefix sums over rows are kept.
constexpr int kGroup = kBlockRows;
// The number of CUDA blocks with kBlockRows threads that fit a multiprocessor of every supported GPU.
constexpr int kResident = 6;

// Appends the items of a warp's lanes to a list, with one atomic addition for the warp. All lanes call this.
__device__ void append(bool present, int32_t item, int32_t* list, int32_t* length) {
  const unsigned all = __ballot_sync(kFullWarp, present);
  if (!all) return;
  const int lane = threadIdx.x % 32, leader = __ffs(all) - 1;
  int32_t first = 0;
  if (lane == leader) first = atomicAdd(length, __popc(all));
  first = __shfl_sync(kFullWarp, first, leader);
  if (present) list[first + __popc(all & ((1u << lane) - 1))] = item;
}

// Lists the blocks of the rows ids [n]. One thread per row; the thread of the first row of each block appends
// the block. If rows did not ascend, a block would be listed several times, which only costs time.
__global__ void list_blocks(const int32_t* ids, int64_t n, int32_t* list, int32_t* length) {
  wait_for_earlier_kernels();
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  const int32_t block = i < n ? ids[i] / kBlockRows : 0;
  append(i < n && (i == 0 || ids[i - 1] / kBlockRows != block), block, list, length);
}

// Returns the union of the boxes of each group of kLanes neighbouring lanes.
template <int kLanes> __device__ __forceinline__ SweptBox box_around(SweptBox box) {
#pragma unroll
  for (int offset = kLanes / 2; offset > 0; offset /= 2) {
    SweptBox other;
    for (int axis = 0; axis < 3; ++axis) {
      other.low[axis] = __shfl_xor_sync(kFullWarp, box.low[axis], offset);
      other.high[axis] = __shfl_xor_sync(kFullWarp, box.high[axis], offset);
    }
    other.sigma = __shfl_xor_sync(kFullWarp, box.sigma, offset);
    extend(box, other);
  }
  return box;
}

// Computes the bounds [blocks, kBlockBounds] of the listed blocks (list null: all blocks). A CUDA block
// handles one block of the table at a time, one thread per row.
__global__ void __launch_bounds__(kBlockRows, kResident)
    update_bounds(const BlockRows rows, const int32_t* list, const int32_t* length, float* bounds) {
  __shared__ SweptBox warps[2][kWarps];  // two alternating buffers need only one barrier per block
  wait_for_earlier_kernels();
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int64_t count = list ? *length : blocks_of(rows.n);
  const auto block_at = [&](int64_t i) { return i >= count ? 0 : list ? list[i] : i; };
  int64_t block = block_at(blockIdx.x), next;
  int turn = 0;
  for (int64_t i = blockIdx.x; i < count; i += gridDim.x, turn ^= 1, block = next) {
    next = block_at(i + gridDim.x);  // loaded while the present block is computed
    const bool present = threadIdx.x < rows_in_block(rows.n, block);
    const SweptBox row = present ? sweep_row(rows, block * kBlockRows + threadIdx.x) : empty_box();
    const SweptBox part = box_around<32>(row);
    if (lane == 0) warps[turn][warp] = part;
    const bool all_finite = __syncthreads_and(!present || !is_empty(row));
    if (warp == 0) {
      const SweptBox whole = box_around<kWarps>(warps[turn][lane % kWarps]);
      if (lane == 0) store_bounds(whole, all_finite, bounds + block * kBlockBounds);
    }
  }
}

// Counters of a call, zero at its start.
struct CullCounters {
  RunningSum earlier;  // over the groups of blocks
  int32_t* groups;     // active rows in each group of kGroup blocks of the plan
  int32_t* n_mixed;    // the length of the list `mixed`
};

// The first kernel of cull_blocks: tests the blocks of the table from their bounds. One thread per block of
// the table, one CUDA block per group. Writes to the plan the blocks that some view may see, in order, up to
// its capacity; writes the positions of mixed blocks in the plan to `mixed`, in any order; counts the active
// rows of the other blocks; and writes the planes of the views for test_rows.
template <bool kGated>
__global__ void __launch_bounds__(kGroup)
    test_blocks(const __grid_constant__ CullInputs in, const CullPlan plan, const CullCounters counters,
                int32_t* mixed, int32_t* n_blocks, Frustum* planes_out) {
  __shared__ Frustum planes[kMaxViews];
  __shared__ GateTable table;
  __shared__ int warp_counts[kWarps];
  wait_for_earlier_kernels();
  const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32;
  if (kGated) fill_gate_table(in.gate.rules, in.camera.viewmats, threadIdx.x, table);
  if (thread < in.views) {
    planes[thread] = make_frustum(in.camera, thread);
    if (blockIdx.x == 0) planes_out[thread] = planes[thread];
  }
  const int group = counters.earlier.take_turn();
  const int64_t blocks = blocks_of(in.rows.n), block = group * int64_t{kGroup} + thread;
  BlockViews seen{0, 0, 0};
  if (block < blocks) seen = views_of_block<kGated>(planes, in.views, in.bounds, block, in.gate, table);
  const unsigned ballot = __ballot_sync(kFullWarp, seen.any != 0);
  if (lane == 0) warp_counts[warp] = __popc(ballot);
  __syncthreads();
  int listed_before = __popc(ballot & ((1u << lane) - 1)), count = 0;
#pragma unroll
  for (int other = 0; other < kWarps; ++other) {
    if (other < warp) listed_before += warp_counts[other];
    count += warp_counts[other];
  }
  const int64_t before = counters.earlier.sum_before<kGroup>(group, count), place = before + listed_before;
  if (thread == 0 && (group + 1) * int64_t{kGroup} >= blocks) *n_blocks = int32_t(before + count);
  const bool listed = seen.any && place < plan.capacity_blocks;
  if (listed) {
    plan.blocks[place] = {int32_t(block), seen};
    if (!is_mixed(seen)) {
      const int rows = rows_in_block(in.rows.n, block);
      plan.active[place] = rows;
      atomicAdd(counters.groups + place / kGroup, rows);
    }
  }
  append(listed && is_mixed(seen), int32_t(place), mixed, counters.n_mixed);
}

// The second kernel of cull_blocks: tests the rows of mixed blocks and writes the views that may see each row
// to plan.masks. A CUDA block tests one mixed block at a time, one thread per row.
template <bool kGated>
__global__ void __launch_bounds__(kBlockRows, kResident)
    test_rows(const __grid_constant__ CullInputs in, const CullPlan plan, const CullCounters counters,
              const int32_t* mixed, const int32_t* n_blocks, const Frustum* planes) {
  __shared__ Frustum shared_planes[kMaxViews];
  __shared__ GateTable table;
  wait_for_earlier_kernels();
  const int32_t count = *n_blocks > plan.capacity_blocks ? 0 : *counters.n_mixed;
  if (int32_t(blockIdx.x) >= count) return;
  if (threadIdx.x < in.views) shared_planes[threadIdx.x] = planes[threadIdx.x];
  if (kGated) fill_gate_table(in.gate.rules, in.camera.viewmats, threadIdx.x, table);
  __syncthreads();
  for (int32_t i = blockIdx.x; i < count; i += gridDim.x) {
    const int32_t place = mixed[i];
    const auto [block, seen] = plan.blocks[place];
    const int64_t row = int64_t{block} * kBlockRows + threadIdx.x;
    uint32_t mask = 0;
    if (row < in.rows.n) {
      mask = views_of_row<kGated>(in.rows, shared_planes, in.views, in.bounds, seen, row, in.gate, table);
      plan.masks[int64_t{place} * kBlockRows + threadIdx.x] = mask;
    }
    const int total = __syncthreads_count(mask != 0);
    if (threadIdx.x == 0) {
      plan.active[place] = total;
      atomicAdd(counters.groups + place / kGroup, total);
    }
  }
}

// Returns the number of active rows in the blocks before position `place` of the plan: the rows of earlier
// groups, and those of earlier blocks of the same group. All threads call this.
__device__ int32_t rows_before(const CullPlan& plan, const int32_t* groups, int32_t place) {
  __shared__ int32_t parts[kWarps];
  const int32_t group = place / kGroup, near = group * kGroup + int32_t(threadIdx.x);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  int32_t sum = near < place ? plan.active[near] : 0;
  for (int32_t i = threadIdx.x; i < group; i += kGroup) sum += groups[i];
  sum = __reduce_add_sync(kFullWarp, sum);
  if (lane == 0) parts[warp] = sum;
  __syncthreads();
  return __reduce_add_sync(kFullWarp, lane < kWarps ? parts[lane] : 0);
}

// The third kernel of cull_blocks: lists the active rows and their views, in order. A warp per block.
__global__ void __launch_bounds__(kBlockRows)
    emit_rows(int64_t n, const CullPlan plan, const int32_t* groups, const ActiveList out) {
  wait_for_earlier_kernels();
  const int32_t n_blocks = *out.n_blocks > plan.capacity_blocks ? 0 : *out.n_blocks;
  const int32_t first = int32_t(blockIdx.x) * kWarps;
  if (blockIdx.x == 0 && threadIdx.x == 0 && n_blocks == 0) *out.count = 0;
  if (first >= n_blocks) return;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int32_t place = first + warp, before = rows_before(plan, groups, first);
  const int32_t block_rows = lane < kWarps && first + lane < n_blocks ? plan.active[first + lane] : 0;
  if (first + kWarps >= n_blocks && warp == 0) {
    const int32_t all = before + __reduce_add_sync(kFullWarp, block_rows);
    if (lane == 0) *out.count = all;
  }
  int32_t first_place = before + __reduce_add_sync(kFullWarp, lane < warp ? block_rows : 0);
  if (place >= n_blocks) return;
  const auto [block, seen] = plan.blocks[place];
  const bool mixed = is_mixed(seen);
  const int count = rows_in_block(n, block);
#pragma unroll
  for (int local = lane; local < kBlockRows; local += 32) {
    const uint32_t mask = local >= count ? 0
                          : mixed        ? plan.masks[int64_t{place} * kBlockRows + local]
                                         : seen.all;
    const uint32_t ballot = __ballot_sync(kFullWarp, mask != 0);
    const int32_t target = first_place + __popc(ballot & ((1u << lane) - 1));
    if (mask) {
      out.ids[target] = block * kBlockRows + local;
      out.views[target] = int32_t(mask);
    }
    first_place += __popc(ballot);
  }
}

// Finds the blocks that some view may see. If the capacity is not 0, also lists their active rows.
void cull(const CullInputs& in, const ActiveList& out, Workspace& workspace, CudaStream stream) {
  const CullPlan plan(out.capacity_blocks, workspace);
  int32_t* mixed = workspace.allocate<int32_t>(out.capacity_blocks);
  Frustum* planes = workspace.allocate<Frustum>(in.views);
  const unsigned turns = blocks_for(blocks_of(in.rows.n), kGroup),
                 n_groups = blocks_for(out.capacity_blocks, kGroup);
  auto* sums = workspace.allocate<uint64_t>(turns + 1 + (n_groups + 2) / 2);
  auto* groups = reinterpret_cast<int32_t*>(sums + turns + 1);
  const CullCounters counters{RunningSum(sums), groups, groups + n_groups};
  zero("cull_blocks", reinterpret_cast<int32_t*>(sums), 2 * (turns + 1) + n_groups + 1, stream);
  const bool gated = leaves_out_any(in.gate.rules);
  launch_early("cull_blocks", gated ? test_blocks<true> : test_blocks<false>, {turns, kGroup, stream}, in,
               plan, counters, mixed, out.n_blocks, planes);
  if (out.capacity_blocks == 0) return;
  launch_early("cull_blocks", gated ? test_rows<true> : test_rows<false>,
               {resident_blocks(out.capacity_blocks, 1, kResident), kBlockRows, stream}, in, plan, counters,
               mixed, out.n_blocks, planes);
  launch_early("cull_blocks", emit_rows, {blocks_for(out.capacity_blocks, kWarps), kBlockRows, stream},
               in.rows.n, plan, groups, out);
}

__global__ void make_keys(const float* points, int64_t n, const MortonBounds* bounds, int64_t* keys) {
  const int64_t i = blockIdx.x * int64_t{blockDim.x} + threadIdx.x;
  if (i < n) keys[i] = int64_t(morton_code(points + 3 * i, frame_of(*bounds)) >> 1);
}

}  // namespace

void update_block_bounds(const BlockRows& rows, const int32_t* ids, int64_t n_ids, float* bounds,
                         Workspace& workspace, CudaStream stream) {
  const int64_t blocks = blocks_of(rows.n);
  if (blocks == 0 || (ids && n_ids == 0)) return;
  int32_t *list = nullptr, *length = nullptr;
  if (ids) {
    length = workspace.allocate<int32_t>(1 + n_ids);
    list = length + 1;
    zero("update_block_bounds", length, 1, stream);
    launch_early("update_block_bounds", list_blocks, {blocks_for(n_ids, 256), 256, stream}, ids, n_ids, list,
                 length);
  }
  launch_early("update_block_bounds", update_bounds,
               {resident_blocks(blocks, 1, kResident), kBlockRows, stream}, rows, list, length, bounds);
}

int64_t count_active_blocks(const CullInputs& in, Workspace& workspace, CudaStream stream) {
  if (in.rows.n == 0) return 0;
  auto* n_blocks = workspace.allocate<int32_t>(1);
  cull(in, {nullptr, nullptr, nullptr, n_blocks, 0}, workspace, stream);
  return read_back("cull_blocks", n_blocks, stream);
}

void cull_blocks(const CullInputs& in, const ActiveList& out, Workspace& workspace, CudaStream stream) {
  if (in.rows.n == 0 || out.capacity_blocks == 0) {
    check(cudaMemsetAsync(out.count, 0, sizeof(*out.count), stream), "cull_blocks");
    check(cudaMemsetAsync(out.n_blocks, 0, sizeof(*out.n_blocks), stream), "cull_blocks");
  }
  if (in.rows.n > 0) cull(in, out, workspace, stream);
}

void morton_keys(const float* points, int64_t n, int64_t* keys, Workspace& workspace, CudaStream stream) {
  if (n == 0) return;
  const MortonBounds* bounds = find_morton_bounds(points, n, workspace, stream);
  make_keys<<<blocks_for(n, 256), 256, 0, stream>>>(points, n, bounds, keys);
  check_launch("morton_keys");
}

}  // namespace blitzgs::cuda
