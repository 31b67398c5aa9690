// SPDX-License-Identifier: Apache-2.0
// Ops for a table that is larger than the memory of a GPU. The table is in the memory of the host, and a pool
// on the device holds some of its blocks. seen_blocks finds the blocks that some views may see; swap_blocks_
// moves blocks between the table and the pool.
//
// A block is 256 consecutive rows (active/blocks.h). A slot is the memory of one block in the pool.
#pragma once
#include "active/blocks.h"

namespace blitzgs {

constexpr int kMaxSwapColumns = 48;
// Twice the slack of cull_blocks, because its test is compiled in another file and may round differently.
constexpr float kSeenSlack = 2 * kBlockSlack;

// bounds [n, kBlockBounds], those of each block; seen [n]: bit v is set if view v may see a part of the
// block. The test is that of cull_blocks with more slack, so cull_blocks reads no row of a block for which no
// bit is set. Each view has its own image size.
struct SeenBlocks {
  const float* bounds;
  int64_t n;
  const float *viewmats, *Ks;  // [V, 4, 4], [V, 3, 3]
  const int32_t* sizes;        // [V, 2], width and height in pixels
  int views;                   // at most kMaxViews
  float near_plane, far_plane, eps2d;
  int32_t* seen;
};

// One column of the pool and of the table, with `bytes` bytes per block.
struct SwapColumn {
  std::byte *pool, *table;
  int64_t bytes;
  bool is_written;  // whether blocks that leave are written back
};

// Moves blocks between slots and the table. For each i, the contents of slot slots[i] are written to block
// leaving[i] of the table (-1: not written), then the slot is filled with block coming[i] (-1: not filled).
// All slots differ, as do all leaving and all coming blocks, and no block is both leaving and coming, so the
// moves may be made in any order.
//
// On CUDA the columns of the table are in pinned memory of the host, which the kernel reads and writes
// itself. The old and the new contents of a slot use both directions of the bus at the same time, and one
// launch is enough for any number of blocks and columns.
struct SwapBlocks {
  const int32_t *slots, *leaving, *coming;  // [n]
  int64_t n;
  SwapColumn columns[kMaxSwapColumns];
  int n_columns;
};

BLITZGS_HD int32_t views_that_see(const SeenBlocks& args, const Frustum* planes, int64_t block) {
  const SweptBox box = load_box(args.bounds + block * kBlockBounds);
  uint32_t seen = 0;
  for (int view = 0; view < args.views; ++view) {
    if (visibility_of(planes[view], box, kSeenSlack).any) seen |= 1u << view;
  }
  return int32_t(seen);
}

BLITZGS_HD Frustum frustum_of(const SeenBlocks& args, int view) {
  return make_frustum({args.viewmats, args.Ks, args.sizes[2 * view], args.sizes[2 * view + 1],
                       args.near_plane, args.far_plane, args.eps2d},
                      view);
}

namespace BLITZGS_BACKEND {
void seen_blocks(const SeenBlocks&, CudaStream);
void swap_blocks(const SwapBlocks&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
