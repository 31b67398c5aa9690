// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "blocks/blocks.h"
#include "common/parallel.h"

namespace blitzgs::cpu {

namespace {

void bound_block(const BlockRows& rows, std::int64_t block, float* bounds) {
  SweptBox box = empty_box();
  bool all_finite = true;
  const std::int64_t end = std::min(rows.n, (block + 1) * kBlockRows);
  for (std::int64_t row = block * kBlockRows; row < end; ++row) {
    const SweptBox swept = sweep_row(rows, row);
    extend(box, swept);
    all_finite &= !is_empty(swept);
  }
  store_bounds(box, all_finite, bounds + block * kBlockBounds);
}

// Finds the views of each block, the views of the rows of mixed blocks, and the number of active rows of each
// block.
template <bool kGated>
void fill_plan(const BlockRows& rows, const float* bounds, const CullCamera& camera, int views,
               const BlockGate& gate, const CullPlan& plan, Workspace& workspace) {
  Frustum planes[kMaxViews];
  GateTable table = gate.rules.table;
  for (int view = 0; view < views; ++view) {
    planes[view] = make_frustum(camera, view);
    camera_centre(camera.viewmats + 16 * view, table.centres[view]);
  }
  const std::int64_t blocks = blocks_of(rows.n);
  parallel_for(0, blocks, 1024, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      plan.blocks[block] = views_of_block<kGated>(planes, views, bounds, block, gate, table);
      plan.active[block] = plan.blocks[block].all ? rows_in_block(rows.n, block) : 0;
    }
  });
  std::int32_t* mixed = workspace.allocate<std::int32_t>(blocks);
  std::int64_t count = 0;
  for (std::int64_t block = 0; block < blocks; ++block) {
    if (is_mixed(plan.blocks[block])) mixed[count++] = static_cast<std::int32_t>(block);
  }
  parallel_for(0, count, 16, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int64_t block = mixed[i], first = block * kBlockRows;
      plan.active[block] = 0;
      for (std::int64_t row = first; row < first + rows_in_block(rows.n, block); ++row) {
        plan.masks[row] =
            views_of_row<kGated>(rows, planes, views, bounds, plan.blocks[block], row, gate, table);
        plan.active[block] += plan.masks[row] != 0;
      }
    }
  });
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
      if (touched[block]) bound_block(rows, block, bounds);
    }
  });
}

void cull_blocks(const BlockRows& rows, const float* bounds, const CullCamera& camera, int views,
                 const BlockGate& gate, const ActiveList& list, Workspace& workspace, CudaStream) {
  const std::int64_t blocks = blocks_of(rows.n);
  const CullPlan plan(rows.n, workspace);
  const auto fill = leaves_out_any(gate.rules) ? fill_plan<true> : fill_plan<false>;
  fill(rows, bounds, camera, views, gate, plan, workspace);
  std::int32_t before = 0;
  for (std::int64_t block = 0; block < blocks; ++block) {
    const std::int32_t own = plan.active[block];
    plan.active[block] = before;
    before += own;
  }
  *list.count = before;
  parallel_for(0, blocks, 64, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      if (!plan.blocks[block].some) continue;
      std::int64_t at = plan.active[block];
      const bool mixed_block = is_mixed(plan.blocks[block]);
      const std::int64_t first = block * kBlockRows;
      for (std::int64_t row = first; row < first + rows_in_block(rows.n, block); ++row) {
        const std::uint32_t mask = mixed_block ? plan.masks[row] : plan.blocks[block].all;
        if (!mask) continue;
        list.ids[at] = static_cast<std::int32_t>(row);
        list.views[at++] = static_cast<std::int32_t>(mask);
      }
    }
  });
}

}  // namespace blitzgs::cpu
