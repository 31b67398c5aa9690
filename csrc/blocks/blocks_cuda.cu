// SPDX-License-Identifier: Apache-2.0
#include <thrust/iterator/counting_iterator.h>

#include <cub/cub.cuh>

#include "blocks/blocks.h"
#include "common/cuda_check.h"
#include "math/morton_cuda.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kWarps = kBlockRows / 32;

__global__ void make_keys(const float* points, std::int64_t n, const MortonBounds* bounds,
                          std::int64_t* keys) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i < n) keys[i] = static_cast<std::int64_t>(morton_code(points + 3 * i, frame_of(*bounds)) >> 1);
}

__global__ void mark_blocks(const std::int32_t* ids, std::int64_t n, std::uint8_t* touched) {
  const std::int64_t i = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  if (i >= n) return;
  // Rows ascend, so most have the block of the row before: one store a block.
  const std::int32_t block = ids[i] / kBlockRows;
  if (i == 0 || ids[i - 1] / kBlockRows != block) touched[block] = 1;
}

// One CUDA block a block, one thread a row. touched null: all.
__global__ void __launch_bounds__(kBlockRows)
    update_bounds(const BlockRows rows, const std::uint8_t* touched, float* bounds) {
  if (touched && !touched[blockIdx.x]) return;
  __shared__ SweptBox warps[kWarps];
  const std::int64_t row = blockIdx.x * std::int64_t{kBlockRows} + threadIdx.x;
  SweptBox box = row < rows.n ? sweep_row(rows, row) : empty_box();
  for (int offset = 16; offset > 0; offset /= 2) {
    SweptBox other;
    for (int axis = 0; axis < 3; ++axis) {
      other.low[axis] = __shfl_xor_sync(~0u, box.low[axis], offset);
      other.high[axis] = __shfl_xor_sync(~0u, box.high[axis], offset);
    }
    other.sigma = __shfl_xor_sync(~0u, box.sigma, offset);
    extend(box, other);
  }
  if (threadIdx.x % 32 == 0) warps[threadIdx.x / 32] = box;
  __syncthreads();
  if (threadIdx.x != 0) return;
  for (int warp = 1; warp < kWarps; ++warp) extend(box, warps[warp]);
  store_box(box, bounds + blockIdx.x * std::int64_t{kBlockBounds});
}

__device__ void load_views(const CullCamera& camera, int views, CullView* planes) {
  if (threadIdx.x < views) planes[threadIdx.x] = make_cull_view(camera, threadIdx.x);
  __syncthreads();
}

__global__ void test_blocks(const float* bounds, std::int64_t blocks, CullCamera camera, int views,
                            std::uint32_t* masks) {
  __shared__ CullView planes[kMaxViews];
  load_views(camera, views, planes);
  const std::int64_t block = blockIdx.x * std::int64_t{blockDim.x} + threadIdx.x;
  const std::uint32_t all = views == kMaxViews ? ~0u : (1u << views) - 1;
  if (block < blocks)
    masks[block] = views_of(planes, views, all, load_box(bounds + block * kBlockBounds), kBlockSlack);
}

// Blocks of the list in turn, a thread a row. The list's length stays on the device.
__global__ void __launch_bounds__(kBlockRows)
    test_rows(const BlockRows rows, CullCamera camera, int views, const std::uint32_t* block_masks,
              const CullPlan plan, std::int64_t* active) {
  __shared__ CullView planes[kMaxViews];
  load_views(camera, views, planes);
  const std::int64_t count = *plan.device_count;
  for (std::int64_t i = blockIdx.x; i < count; i += gridDim.x) {
    const std::int32_t block = plan.blocks[i];
    const std::int64_t row = std::int64_t{block} * kBlockRows + threadIdx.x;
    std::uint32_t mask = 0;
    if (row < rows.n) mask = views_of(planes, views, block_masks[block], sweep_row(rows, row), kRowSlack);
    plan.masks[i * kBlockRows + threadIdx.x] = mask;
    const int total = __syncthreads_count(mask != 0);
    if (threadIdx.x == 0) active[i] = total;
  }
}

__global__ void __launch_bounds__(kBlockRows)
    emit_rows(const CullPlan plan, std::int32_t* active_ids, std::int32_t* active_views) {
  __shared__ int before[kWarps];
  const std::int64_t count = *plan.device_count;
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  for (std::int64_t i = blockIdx.x; i < count; i += gridDim.x) {
    const std::uint32_t mask = plan.masks[i * kBlockRows + threadIdx.x];
    const std::uint32_t ballot = __ballot_sync(~0u, mask != 0);
    __syncthreads();
    if (lane == 0) before[warp] = __popc(ballot);
    __syncthreads();
    if (!mask) continue;
    std::int64_t at = plan.rows_before[i] + __popc(ballot & ((1u << lane) - 1));
    for (int w = 0; w < warp; ++w) at += before[w];
    active_ids[at] = plan.blocks[i] * kBlockRows + threadIdx.x;
    active_views[at] = static_cast<std::int32_t>(mask);
  }
}

struct IsSet {
  const std::uint32_t* masks;
  __device__ bool operator()(std::int32_t block) const { return masks[block] != 0; }
};

unsigned persistent_blocks(std::int64_t blocks) {
  int device = 0, count = 0;
  check(cudaGetDevice(&device), "cull_blocks");
  check(cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device), "cull_blocks");
  return static_cast<unsigned>(std::min<std::int64_t>(blocks, 8 * count));
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
                         Workspace& workspace, CudaStream stream) {
  const std::int64_t blocks = blocks_of(rows.n);
  if (blocks == 0 || (ids && n_ids == 0)) return;
  std::uint8_t* touched = nullptr;
  if (ids) {
    touched = workspace.allocate<std::uint8_t>(blocks);
    check(cudaMemsetAsync(touched, 0, blocks, stream), "update_block_bounds");
    mark_blocks<<<blocks_for(n_ids, 256), 256, 0, stream>>>(ids, n_ids, touched);
  }
  update_bounds<<<static_cast<unsigned>(blocks), kBlockRows, 0, stream>>>(rows, touched, bounds);
  check_launch("update_block_bounds");
}

void cull_count(const BlockRows& rows, const float* bounds, const CullCamera& camera, int views,
                CullPlan& plan, Workspace& workspace, CudaStream stream) {
  const std::int64_t blocks = blocks_of(rows.n);
  plan.total = 0;
  if (blocks == 0) return;
  std::uint32_t* block_masks = workspace.allocate<std::uint32_t>(blocks);
  test_blocks<<<blocks_for(blocks, 128), 128, 0, stream>>>(bounds, blocks, camera, views, block_masks);
  plan.blocks = workspace.allocate<std::int32_t>(blocks);
  plan.masks = workspace.allocate<std::uint32_t>(blocks * kBlockRows);
  plan.device_count = workspace.allocate<std::int64_t>(1);
  std::int64_t* active = workspace.allocate<std::int64_t>(blocks + 1);
  plan.rows_before = workspace.allocate<std::int64_t>(blocks + 1);
  check(cudaMemsetAsync(active, 0, (blocks + 1) * sizeof(std::int64_t), stream), "cull_blocks");

  const thrust::counting_iterator<std::int32_t> all(0);
  std::size_t select_bytes = 0, scan_bytes = 0;
  check(cub::DeviceSelect::If(nullptr, select_bytes, all, plan.blocks, plan.device_count, blocks,
                              IsSet{block_masks}, stream),
        "cull_blocks");
  check(cub::DeviceScan::ExclusiveSum(nullptr, scan_bytes, active, plan.rows_before, blocks + 1, stream),
        "cull_blocks");
  void* scratch = workspace.allocate_bytes(std::max(select_bytes, scan_bytes));
  check(cub::DeviceSelect::If(scratch, select_bytes, all, plan.blocks, plan.device_count, blocks,
                              IsSet{block_masks}, stream),
        "cull_blocks");
  plan.count = persistent_blocks(blocks);  // launch size; the list's own length is device_count
  test_rows<<<static_cast<unsigned>(plan.count), kBlockRows, 0, stream>>>(rows, camera, views, block_masks,
                                                                          plan, active);
  check_launch("cull_blocks");
  check(cub::DeviceScan::ExclusiveSum(scratch, scan_bytes, active, plan.rows_before, blocks + 1, stream),
        "cull_blocks");
  check(cudaMemcpyAsync(&plan.total, plan.rows_before + blocks, sizeof(plan.total), cudaMemcpyDeviceToHost,
                        stream),
        "cull_blocks");
  check(cudaStreamSynchronize(stream), "cull_blocks");
}

void cull_emit(const CullPlan& plan, std::int32_t* active_ids, std::int32_t* active_views, Workspace&,
               CudaStream stream) {
  if (plan.total == 0) return;
  emit_rows<<<static_cast<unsigned>(plan.count), kBlockRows, 0, stream>>>(plan, active_ids, active_views);
  check_launch("cull_blocks");
}

}  // namespace blitzgs::cuda
