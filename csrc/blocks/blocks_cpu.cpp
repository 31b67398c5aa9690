// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "blocks/blocks.h"
#include "common/parallel.h"

namespace blitzgs::cpu {

namespace {

SweptBox sweep_block(const BlockRows& rows, std::int64_t block) {
  SweptBox box = empty_box();
  const std::int64_t end = std::min(rows.n, (block + 1) * kBlockRows);
  for (std::int64_t row = block * kBlockRows; row < end; ++row) extend(box, sweep_row(rows, row));
  return box;
}

}  // namespace

void morton_keys(const float* points, std::int64_t n, std::int64_t* keys, Workspace&, CudaStream) {
  const MortonFrame frame = morton_frame_of(points, n);
  parallel_for(0, n, 1 << 14, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      keys[i] = static_cast<std::int64_t>(morton_code(points + 3 * i, frame) >> 1);
    }
  });
}

void update_block_bounds(const BlockRows& rows, const std::int32_t* ids, std::int64_t n_ids, float* bounds,
                         Workspace& workspace, CudaStream) {
  const std::int64_t blocks = blocks_of(rows.n);
  std::uint8_t* touched = workspace.allocate<std::uint8_t>(blocks);
  std::fill_n(touched, blocks, static_cast<std::uint8_t>(ids == nullptr));
  for (std::int64_t i = 0; ids && i < n_ids; ++i) touched[ids[i] / kBlockRows] = 1;
  parallel_for(0, blocks, 16, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      if (touched[block]) store_box(sweep_block(rows, block), bounds + block * kBlockBounds);
    }
  });
}

void cull_count(const BlockRows& rows, const float* bounds, const CullCamera& camera, int views,
                CullPlan& plan, Workspace& workspace, CudaStream) {
  CullView planes[kMaxViews];
  for (int view = 0; view < views; ++view) planes[view] = make_cull_view(camera, view);
  const std::uint32_t all = views == kMaxViews ? ~0u : (1u << views) - 1;
  const std::int64_t blocks = blocks_of(rows.n);
  std::uint32_t* block_masks = workspace.allocate<std::uint32_t>(blocks);
  parallel_for(0, blocks, 1024, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      block_masks[block] = views_of(planes, views, all, load_box(bounds + block * kBlockBounds), kBlockSlack);
    }
  });
  plan.blocks = workspace.allocate<std::int32_t>(blocks);
  plan.count = 0;
  for (std::int64_t block = 0; block < blocks; ++block) {
    if (block_masks[block]) plan.blocks[plan.count++] = static_cast<std::int32_t>(block);
  }
  plan.masks = workspace.allocate<std::uint32_t>(plan.count * kBlockRows);
  plan.rows_before = workspace.allocate<std::int64_t>(plan.count + 1);
  parallel_for(0, plan.count, 16, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::uint32_t* masks = plan.masks + i * kBlockRows;
      std::int64_t active = 0;
      for (int local = 0; local < kBlockRows; ++local) {
        const std::int64_t row = std::int64_t{plan.blocks[i]} * kBlockRows + local;
        const std::uint32_t candidates = row < rows.n ? block_masks[plan.blocks[i]] : 0;
        masks[local] = candidates ? views_of(planes, views, candidates, sweep_row(rows, row), kRowSlack) : 0;
        active += masks[local] != 0;
      }
      plan.rows_before[i + 1] = active;
    }
  });
  plan.rows_before[0] = 0;
  for (std::int64_t i = 0; i < plan.count; ++i) plan.rows_before[i + 1] += plan.rows_before[i];
  plan.total = plan.rows_before[plan.count];
}

void cull_emit(const CullPlan& plan, std::int32_t* active_ids, std::int32_t* active_views, Workspace&,
               CudaStream) {
  parallel_for(0, plan.count, 64, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::int64_t at = plan.rows_before[i];
      for (int local = 0; local < kBlockRows; ++local) {
        const std::uint32_t mask = plan.masks[i * kBlockRows + local];
        if (!mask) continue;
        active_ids[at] = plan.blocks[i] * kBlockRows + local;
        active_views[at++] = static_cast<std::int32_t>(mask);
      }
    }
  });
}

}  // namespace blitzgs::cpu
