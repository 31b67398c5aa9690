// SPDX-License-Identifier: Apache-2.0
#include <utility>
#include <vector>

#include "active/blocks.h"
#include "active/pool.h"
#include "active/view_gate.h"
#include "common/parallel.h"
#include "math/morton.h"

namespace blitzgs::cpu {
namespace {

void bound_block(const BlockRows& rows, int64_t block, float* bounds) {
  SweptBox box = empty_box();
  bool all_finite = true;
  const int64_t end = std::min(rows.n, (block + 1) * kBlockRows);
  for (int64_t row = block * kBlockRows; row < end; ++row) {
    const SweptBox swept = sweep_row(rows, row);
    extend(box, swept);
    all_finite &= !is_empty(swept);
  }
  store_bounds(box, all_finite, bounds + block * kBlockBounds);
}

// The frusta of the views and the table of the gate.
struct CullViews {
  Frustum planes[kMaxViews];
  GateTable table;

  explicit CullViews(const CullInputs& in) : table(in.gate.rules.table) {
    for (int view = 0; view < in.views; ++view) {
      planes[view] = make_frustum(in.camera, view);
      camera_centre(in.camera.viewmats + 16 * view, table.centres[view]);
    }
  }
};

// Returns the blocks that some view may see, in order.
template <bool kGated> std::vector<ActiveBlock> list_blocks(const CullInputs& in, const CullViews& views) {
  constexpr int64_t kPart = 1024;
  const int64_t blocks = blocks_of(in.rows.n);
  std::vector<std::vector<ActiveBlock>> parts((blocks + kPart - 1) / kPart);
  parallel_rows(int64_t(parts.size()), 1, [&](int64_t part) {
    for (int64_t block = part * kPart; block < std::min(blocks, (part + 1) * kPart); ++block) {
      const BlockViews seen =
          views_of_block<kGated>(views.planes, in.views, in.bounds, block, in.gate, views.table);
      if (seen.any) parts[part].push_back({int32_t(block), seen});
    }
  });
  std::vector<ActiveBlock> active;
  for (const std::vector<ActiveBlock>& part : parts) active.insert(active.end(), part.begin(), part.end());
  return active;
}

std::vector<ActiveBlock> active_blocks(const CullInputs& in, const CullViews& views) {
  return leaves_out_any(in.gate.rules) ? list_blocks<true>(in, views) : list_blocks<false>(in, views);
}

// Finds the views of the rows of mixed blocks, and the number of active rows of each block.
template <bool kGated> void fill_plan(const CullInputs& in, const CullViews& views, const CullPlan& plan) {
  parallel_rows(plan.capacity_blocks, 16, [&](int64_t place) {
    const auto& [block, seen] = plan.blocks[place];
    const int count = rows_in_block(in.rows.n, block);
    plan.active[place] = count;
    if (!is_mixed(seen)) return;
    plan.active[place] = 0;
    for (int local = 0; local < count; ++local) {
      uint32_t& mask = plan.masks[place * kBlockRows + local];
      mask = views_of_row<kGated>(in.rows, views.planes, in.views, in.bounds, seen,
                                  int64_t{block} * kBlockRows + local, in.gate, views.table);
      plan.active[place] += mask != 0;
    }
  });
}

// Transposes 32 x 32 bits: bit j of word i becomes bit i of word j. It swaps the off-diagonal quarters of
// squares of 32, 16, 8, 4 and 2 bits.
void transpose_bits(uint32_t* words) {
  uint32_t low = 0x0000ffffu;  // the columns of each square's left half
  for (int half = 16; half > 0; half /= 2, low ^= low << half) {
    for (int i = 0; i < 32; ++i) {
      if (i & half) continue;
      const uint32_t swapped = (words[i] >> half ^ words[i + half]) & low;
      words[i] ^= swapped << half;
      words[i + half] ^= swapped;
    }
  }
}

// Calls f(words, count, rows, sector) for each square of 32 rows and 32 columns. words: 32 zeros. count: the
// existing rows. rows, sector: the words of the first row and the first column.
template <class F> void for_each_square(const CullMask& mask, const F& f) {
  parallel_rows(blocks_of(mask.n) * kSectorWords, 64, [&](int64_t group) {
    const auto count = int(std::clamp<int64_t>(mask.n - 32 * group, 0, 32));
    for (int64_t word = 0; word < mask.words; ++word) {
      uint32_t words[32] = {};
      int32_t* sector =
          mask.sectors + group % kSectorWords + sector_at(group / kSectorWords, 32 * mask.words, 32 * word);
      f(words, count, mask.rows + 32 * group * mask.words + word, sector);
    }
  });
}

}  // namespace

void update_block_bounds(const BlockRows& rows, const int32_t* ids, int64_t n_ids, float* bounds,
                         Workspace& workspace, CudaStream) {
  int64_t count = blocks_of(rows.n);
  int32_t* list = nullptr;
  if (ids) {
    list = workspace.allocate<int32_t>(n_ids);
    std::transform(ids, ids + n_ids, list, [](int32_t row) { return row / kBlockRows; });
    if (!std::is_sorted(list, list + n_ids)) std::sort(list, list + n_ids);
    count = std::unique(list, list + n_ids) - list;
  }
  parallel_rows(count, 16, [&](int64_t i) { bound_block(rows, list ? list[i] : i, bounds); });
}

int64_t count_active_blocks(const CullInputs& in, Workspace&, CudaStream) {
  return int64_t(active_blocks(in, CullViews(in)).size());
}

void cull_blocks(const CullInputs& in, const ActiveList& list, Workspace& workspace, CudaStream) {
  const CullViews views(in);
  const std::vector<ActiveBlock> blocks = active_blocks(in, views);
  const auto n_blocks = int64_t(blocks.size());
  *list.n_blocks = int32_t(n_blocks);
  *list.count = 0;
  if (n_blocks > list.capacity_blocks) return;
  const CullPlan plan(n_blocks, workspace);
  std::copy(blocks.begin(), blocks.end(), plan.blocks);
  (leaves_out_any(in.gate.rules) ? fill_plan<true> : fill_plan<false>)(in, views, plan);
  for (int64_t place = 0; place < n_blocks; ++place) {
    *list.count += std::exchange(plan.active[place], *list.count);
  }
  parallel_rows(n_blocks, 64, [&](int64_t place) {
    const auto& [block, seen] = plan.blocks[place];
    int64_t at = plan.active[place];
    for (int local = 0; local < rows_in_block(in.rows.n, block); ++local) {
      const uint32_t mask = is_mixed(seen) ? plan.masks[place * kBlockRows + local] : seen.all;
      if (!mask) continue;
      list.ids[at] = block * kBlockRows + local;
      list.views[at++] = int32_t(mask);
    }
  });
}

void morton_keys(const float* points, int64_t n, int64_t* keys, Workspace&, CudaStream) {
  const MortonFrame frame = morton_frame_of(points, n);
  parallel_rows(n, 1 << 14, [&](int64_t i) { keys[i] = int64_t(morton_code(points + 3 * i, frame) >> 1); });
}

void seen_blocks(const SeenBlocks& args, CudaStream) {
  Frustum planes[kMaxViews];
  for (int view = 0; view < args.views; ++view) planes[view] = frustum_of(args, view);
  parallel_rows(args.n, 1024, [&](int64_t block) { args.seen[block] = views_that_see(args, planes, block); });
}

void swap_blocks(const SwapBlocks& swap, CudaStream) {
  parallel_rows(swap.n, 4, [&](int64_t i) {
    for (int c = 0; c < swap.n_columns; ++c) {
      const SwapColumn& column = swap.columns[c];
      const auto bytes = size_t(column.bytes);
      std::byte* slot = column.pool + swap.slots[i] * column.bytes;
      if (swap.leaving[i] >= 0 && column.is_written) {
        std::memcpy(column.table + swap.leaving[i] * column.bytes, slot, bytes);
      }
      if (swap.coming[i] >= 0) std::memcpy(slot, column.table + swap.coming[i] * column.bytes, bytes);
    }
  });
}

void sectors_of_rows(const CullMask& mask, CudaStream) {
  for_each_square(mask, [&](uint32_t* words, int count, const int32_t* rows, int32_t* sector) {
    for (int i = 0; i < count; ++i) words[i] = uint32_t(rows[i * mask.words]);
    transpose_bits(words);
    for (int i = 0; i < 32; ++i) sector[i * kSectorWords] = int32_t(words[i]);
  });
}

void rows_of_sectors(const CullMask& mask, CudaStream) {
  for_each_square(mask, [&](uint32_t* words, int count, int32_t* rows, const int32_t* sector) {
    for (int i = 0; i < 32; ++i) words[i] = uint32_t(sector[i * kSectorWords]);
    transpose_bits(words);
    for (int i = 0; i < count; ++i) rows[i * mask.words] = int32_t(words[i]);
  });
}

void gate_views(const ViewGateArgs& args, CudaStream) {
  GateTable table = args.rules.table;
  for (int view = 0; view < args.rules.n_views; ++view)
    camera_centre(args.viewmats + 16 * view, table.centres[view]);
  parallel_rows(args.capacity, 4096, [&](int64_t i) { gate_entry(args, table, i); });
}

}  // namespace blitzgs::cpu
