// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "blocks/blocks.h"
#include "common/cuda_check.h"
#include "common/multiprocessors.h"
#include "intersect/running_sum.cuh"
#include "math/morton_cuda.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kWarps = kBlockRows / 32;
constexpr int kListed = 16;   // blocks whose rows a CUDA block lists; up to 32
constexpr int kResident = 6;  // CUDA blocks of a row a thread that a multiprocessor holds, of any generation

__global__ void make_keys(const float* points, std::int64_t n, const MortonBounds* bounds,
                          std::int64_t* keys) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < n) keys[i] = static_cast<std::int64_t>(morton_code(points + 3 * i, frame_of(*bounds)) >> 1);
}

// Items of a warp's lanes take neighbouring places in a list: one addition a warp. All lanes call.
__device__ void append(bool present, std::int32_t item, std::int32_t* list, std::int32_t* length) {
  const unsigned all = __ballot_sync(~0u, present);
  if (!all) return;
  const int lane = threadIdx.x % 32, leader = __ffs(all) - 1;
  std::int32_t first = 0;
  if (lane == leader) first = atomicAdd(length, __popc(all));
  first = __shfl_sync(~0u, first, leader);
  if (present) list[first + __popc(all & ((1u << lane) - 1))] = item;
}

// The box around those of each kLanes neighbouring lanes.
template <int kLanes>
__device__ __forceinline__ SweptBox box_around(SweptBox box) {
#pragma unroll
  for (int offset = kLanes / 2; offset > 0; offset /= 2) {
    SweptBox other;
    for (int axis = 0; axis < 3; ++axis) {
      other.low[axis] = __shfl_xor_sync(~0u, box.low[axis], offset);
      other.high[axis] = __shfl_xor_sync(~0u, box.high[axis], offset);
    }
    other.sigma = __shfl_xor_sync(~0u, box.sigma, offset);
    extend(box, other);
  }
  return box;
}

// Bounds of one block, a thread a row; all threads call. Calls take turns 0 and 1, so that one barrier is
// enough.
__device__ void update_block(const BlockRows& rows, std::int64_t block, int turn, float* bounds) {
  __shared__ SweptBox warps[2][kWarps];
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
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

__global__ void __launch_bounds__(kBlockRows, kResident) update_bounds(const BlockRows rows, float* bounds) {
  int turn = 0;
  for (std::int64_t block = blockIdx.x; block < blocks_of(rows.n); block += gridDim.x, turn ^= 1)
    update_block(rows, block, turn, bounds);
}

// The same for the blocks of the rows ids [n], each CUDA block with kBlockRows of those. Rows ascend, so a
// block is updated where its first row is met; otherwise more often, which costs time alone.
__global__ void __launch_bounds__(kBlockRows, kResident)
    update_bounds_of(const BlockRows rows, const std::int32_t* ids, std::int64_t n, float* bounds) {
  __shared__ std::int32_t blocks[kBlockRows];
  __shared__ int count;
  if (threadIdx.x == 0) count = 0;
  const std::int64_t i = blockIdx.x * std::int64_t{kBlockRows} + threadIdx.x;
  const std::int32_t block = i < n ? ids[i] / kBlockRows : 0;
  const bool first = i < n && (i == 0 || ids[i - 1] / kBlockRows != block);
  __syncthreads();
  append(first, block, blocks, &count);
  __syncthreads();
  for (int k = 0; k < count; ++k) update_block(rows, blocks[k], k % 2, bounds);
}

// One thread a block. Lists the mixed blocks, in any order, and counts the active rows of the others. Leaves
// the planes of the views for test_rows.
__global__ void test_blocks(const float* bounds, CullCamera camera, int views, const CullPlan plan,
                            std::int32_t* list, std::int32_t* length, CullView* planes_out) {
  __shared__ CullView planes[kMaxViews];
  const int thread = threadIdx.x;
  if (thread < views) {
    planes[thread] = make_cull_view(camera, thread);
    if (blockIdx.x == 0) planes_out[thread] = planes[thread];
  }
  __syncthreads();
  const std::int64_t blocks = blocks_of(plan.n), block = blockIdx.x * std::int64_t{blockDim.x} + thread;
  BlockViews seen{0, 0};
  if (block < blocks) {
    plan.blocks[block] = seen = views_of_block(planes, views, bounds + block * kBlockBounds);
    plan.active[block] = seen.all ? rows_in_block(plan.n, block) : 0;  // of a mixed one counted later
  }
  append(is_mixed(seen), static_cast<std::int32_t>(block), list, length);
}

// Blocks of the list in turn, a thread a row.
__global__ void __launch_bounds__(kBlockRows, kResident)
    test_rows(const BlockRows rows, const CullView* planes, int views, const CullPlan plan,
              const std::int32_t* list, const std::int32_t* length) {
  __shared__ CullView shared[kMaxViews];
  const std::int32_t count = *length;
  if (static_cast<std::int32_t>(blockIdx.x) >= count) return;
  if (threadIdx.x < views) shared[threadIdx.x] = planes[threadIdx.x];
  __syncthreads();
  for (std::int32_t i = blockIdx.x; i < count; i += gridDim.x) {
    const std::int64_t block = list[i], row = block * kBlockRows + threadIdx.x;
    std::uint32_t mask = 0;
    if (row < rows.n) {
      mask = views_of_row(shared, views, plan.blocks[block], sweep_row(rows, row));
      plan.masks[row] = mask;
    }
    const int total = __syncthreads_count(mask != 0);
    if (threadIdx.x == 0) plan.active[block] = total;
  }
}

// A CUDA block has kListed blocks, a warp every kWarps-th of them.
__global__ void __launch_bounds__(kBlockRows)
    emit_rows(const CullPlan plan, const RunningSum running, const ActiveList list) {
  __shared__ std::int32_t rows_before[kListed];
  __shared__ BlockViews views_of[kListed];
  const std::int64_t blocks = blocks_of(plan.n);
  const int turn = running.take_turn(), warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const std::int64_t first = turn * std::int64_t{kListed};
  const bool present = lane < kListed && first + lane < blocks;
  if (warp == 1 && present) views_of[lane] = plan.blocks[first + lane];
  if (warp == 0) {
    const std::int32_t own = present ? plan.active[first + lane] : 0;
    const std::int32_t until = sum_of_lanes_until(own, lane), all = __shfl_sync(kFullWarp, until, 31);
    const auto before = static_cast<std::int32_t>(running.sum_before(turn, all));
    if (present) rows_before[lane] = before + until - own;
    if (lane == 0 && first + kListed >= blocks) *list.count = before + all;
  }
  __syncthreads();
  for (int i = warp; i < kListed && first + i < blocks; i += kWarps) {
    const std::int64_t block = first + i;
    const BlockViews seen = views_of[i];
    if (!seen.some) continue;
    const bool mixed = is_mixed(seen);
    const int count = rows_in_block(plan.n, block);
    std::int32_t at = rows_before[i];
#pragma unroll
    for (int local = lane; local < kBlockRows; local += 32) {
      const std::int64_t row = block * kBlockRows + local;
      const std::uint32_t mask = local >= count ? 0 : mixed ? plan.masks[row] : seen.all;
      const std::uint32_t ballot = __ballot_sync(~0u, mask != 0);
      const std::int32_t place = at + __popc(ballot & ((1u << lane) - 1));
      if (mask) {
        list.ids[place] = static_cast<std::int32_t>(row);
        list.views[place] = static_cast<std::int32_t>(mask);
      }
      at += __popc(ballot);
    }
  }
}

unsigned persistent_blocks(std::int64_t blocks) {
  return static_cast<unsigned>(std::min<std::int64_t>(blocks, kResident * multiprocessors()));
}

}  // namespace

void morton_keys(const float* points, std::int64_t n, std::int64_t* keys, Workspace& workspace,
                 CudaStream stream) {
  if (n == 0) return;
  const MortonBounds* bounds = find_morton_bounds(points, n, workspace, stream);
  make_keys<<<blocks_for(n, 256), 256, 0, stream>>>(points, n, bounds, keys);
  check_launch("morton_keys");
}

void update_block_bounds(const BlockRows& rows, const std::int32_t* ids, std::int64_t n_ids, float* bounds,
                         Workspace&, CudaStream stream) {
  const std::int64_t blocks = blocks_of(rows.n);
  if (blocks == 0 || (ids && n_ids == 0)) return;
  if (ids) {
    update_bounds_of<<<blocks_for(n_ids, kBlockRows), kBlockRows, 0, stream>>>(rows, ids, n_ids, bounds);
  } else {
    update_bounds<<<persistent_blocks(blocks), kBlockRows, 0, stream>>>(rows, bounds);
  }
  check_launch("update_block_bounds");
}

void cull_blocks(const BlockRows& rows, const float* bounds, const CullCamera& camera, int views,
                 const ActiveList& out, Workspace& workspace, CudaStream stream) {
  const std::int64_t blocks = blocks_of(rows.n);
  if (blocks == 0) {
    check(cudaMemsetAsync(out.count, 0, sizeof(*out.count), stream), "cull_blocks");
    return;
  }
  const CullPlan plan(rows.n, workspace);
  std::int32_t* list = workspace.allocate<std::int32_t>(blocks);
  CullView* planes = workspace.allocate<CullView>(views);
  const unsigned listing = blocks_for(blocks, kListed);
  const std::int64_t words = RunningSum::words(listing);
  std::uint64_t* zeros = workspace.allocate<std::uint64_t>(words + 1);
  auto* length = reinterpret_cast<std::int32_t*>(zeros + words);
  check(cudaMemsetAsync(zeros, 0, (words + 1) * sizeof(*zeros), stream), "cull_blocks");
  test_blocks<<<blocks_for(blocks, 256), 256, 0, stream>>>(bounds, camera, views, plan, list, length, planes);
  test_rows<<<persistent_blocks(blocks), kBlockRows, 0, stream>>>(rows, planes, views, plan, list, length);
  emit_rows<<<listing, kBlockRows, 0, stream>>>(plan, RunningSum(zeros), out);
  check_launch("cull_blocks");
}

}  // namespace blitzgs::cuda
