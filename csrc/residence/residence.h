// SPDX-License-Identifier: Apache-2.0
// What keeps a table larger than a GPU's memory in the memory of its host: which blocks some views may see,
// and blocks on their way between the host's table and a pool on the device.
//
// A block is 256 consecutive rows (blocks/blocks.h). The pool has a place for some of the table's blocks,
// each called a slot.
#pragma once
#include <cstddef>
#include <cstdint>

#include "blocks/blocks.h"
#include "common/kernel.h"

namespace blitzgs {

constexpr int kMaxSwapColumns = 48;
// Twice that of cull_blocks, whose test is compiled elsewhere and may round differently.
constexpr float kSeenSlack = 2 * kBlockSlack;

// bounds [n, kBlockBounds], of each block; seen [n]: bit v is set when view v may see a part of the block.
// The test is that of cull_blocks with more slack, so cull_blocks reads no row of a block without the bit of
// any of its views. Views differ in size here.
struct SeenBlocks {
  const float* bounds;
  std::int64_t n;
  const float *viewmats, *Ks;  // [V, 4, 4], [V, 3, 3]
  const std::int32_t* sizes;   // [V, 2], width and height in pixels
  int views;                   // at most kMaxViews
  float near_plane, far_plane, eps2d;
  std::int32_t* seen;
};

// One column of the pool and of the table: blocks of `bytes` each.
struct SwapColumn {
  std::byte *pool, *table;
  std::int64_t bytes;
  bool is_written;  // whether blocks that leave are written back
};

// Moves blocks between slots and the table. Slot slots[i] gives its block to block leaving[i] of the table
// (-1: nobody wants it), then takes block coming[i] (-1: none). All slots, all leaving and all coming blocks
// differ, and no block leaves and comes at once, so that moves may be made in any order.
//
// On CUDA the columns of the table are pinned memory of the host, which the kernel reads and writes itself: a
// slot's old and new contents travel at the same time, in both directions of the bus, and a launch is enough
// for any number of blocks and columns.
struct SwapBlocks {
  const std::int32_t *slots, *leaving, *coming;  // [n]
  std::int64_t n;
  SwapColumn columns[kMaxSwapColumns];
  int n_columns;
};

BLITZGS_HD std::int32_t views_that_see(const SeenBlocks& of, const Frustum* planes, std::int64_t block) {
  const SweptBox box = load_box(of.bounds + block * kBlockBounds);
  std::uint32_t seen = 0;
  for (int view = 0; view < of.views; ++view) {
    if (sight_of(planes[view], box, kSeenSlack).some) seen |= 1u << view;
  }
  return static_cast<std::int32_t>(seen);
}

BLITZGS_HD Frustum frustum_of(const SeenBlocks& of, int view) {
  return make_frustum(
      {of.viewmats, of.Ks, of.sizes[2 * view], of.sizes[2 * view + 1], of.near_plane, of.far_plane, of.eps2d},
      view);
}

namespace cpu {
void seen_blocks(const SeenBlocks&, Workspace&, CudaStream);
void swap_blocks(const SwapBlocks&, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
void seen_blocks(const SeenBlocks&, Workspace&, CudaStream);
void swap_blocks(const SwapBlocks&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
