// SPDX-License-Identifier: Apache-2.0
// What views leave out of the active rows: the cull mask and its layouts, the LOD gate, and the op of both.
#pragma once
#include "common/kernel.h"

// The cull mask has a bit for each row of a table and each column (a training view), in two layouts:
//
//   by row:    int32 [N, words]. Bit v % 32 of word v / 32 is that of column v. In this layout a row of the
//              mask moves together with the row of the table.
//   by sector: int32 [ceil(N / 256), 32 words, 8]. The bits of the 256 rows of a block for one column are the
//              32 bytes of a sector; bit r % 32 of word r / 32 is that of the block's row r. A kernel that
//              needs one column reads one sector per block instead of one word per row, and the sector alone
//              says whether any or all rows of the block have the bit.
//
// The bits of missing rows of the last block are zero. Both conversions transpose 32 x 32 bits at a time;
// they are exact and inverse to each other. The cost is O(N words).
namespace blitzgs {

constexpr int kBlockRows = 256;                // rows of a block of the table
constexpr int kSectorWords = kBlockRows / 32;  // words of a sector

BLITZGS_HD int64_t blocks_of(int64_t rows) { return (rows + kBlockRows - 1) / kBlockRows; }

BLITZGS_HD int64_t sector_at(int64_t block, int64_t n_columns, int64_t column) {
  return (block * n_columns + column) * kSectorWords;
}

BLITZGS_HD bool sector_bit(const int32_t* sectors, int64_t n_columns, int64_t column, int64_t row) {
  const int local = int(row % kBlockRows);
  const int32_t word = sectors[sector_at(row / kBlockRows, n_columns, column) + local / 32];
  return (uint32_t(word) >> local % 32 & 1u) != 0;
}

// Whether any, and whether all, of the first `count` rows of a sector have the bit.
struct SectorBits {
  bool any, all;
};

BLITZGS_HD SectorBits sector_bits(const int32_t* sector, int count) {
  SectorBits bits{false, true};
  for (int word = 0; word < kSectorWords; ++word) {
    const int live = count - 32 * word;
    const uint32_t rows = live >= 32 ? ~0u : live > 0 ? (1u << live) - 1u : 0u;
    const uint32_t set = uint32_t(sector[word]) & rows;
    bits.any |= set != 0;
    bits.all &= set == rows;
  }
  return bits;
}

// The two layouts of a mask of n rows and 32 * words columns.
struct CullMask {
  int32_t *rows, *sectors;
  int64_t n, words;
};

// The view level (BlitzGS, section 3.3; levels as in Octree-GS, Ren et al. 2024): drops pairs of a row and a
// view from the active set before the projection.
//
// LOD gate (Eq. 1 and 2): view v keeps row i iff level_i <= L_v(|mean_i - centre_v|). Eq. 1 rounds
// log_f(d_0 / d) to the nearest integer, so level l is kept up to the distance reach_l = d_0 f^(1/2 - l);
// level 0 at any distance, and a level beyond L_max(t) nowhere (reach < 0). Comparing squared distances
// decides the same sets without a logarithm.
//
// Cull mask: view v drops row i iff its bit in column columns[v] of the cull matrix, by sector, is set.
//
// The op clears the bits of dropped pairs in `views`, in place. The decision for a row depends on this row
// alone, in float32 and from caught-up means, so the sets depend neither on the order of the rows nor on how
// they are divided among ranks. The cost is O(listed rows).

// The values that the rows of a launch are compared with, by view or by level.
struct GateTable {
  float centres[kMaxViews][3];
  float reach2[kMaxLevels];    // squared; negative: the level is kept nowhere
  int32_t columns[kMaxViews];  // columns of the cull matrix; negative: the view has no mask
};

// The rules by which rows of a table are dropped from B views.
struct GateRules {
  const uint8_t* level;  // [N]
  const int32_t* cull;   // [blocks_of(N), cull_columns, kSectorWords]; may be null
  int64_t n_rows, cull_columns;
  int n_views, n_levels;
  uint32_t lod_views;   // bits of the views that have an LOD gate
  uint32_t cull_views;  // bits of the views that have a mask
  GateTable table;      // without the centres, which the kernels compute
};

BLITZGS_HD bool leaves_out_any(const GateRules& rules) { return (rules.lod_views | rules.cull_views) != 0; }

struct ViewGateArgs {
  const int32_t* ids;  // [capacity]
  int32_t* views;      // [capacity]
  int64_t capacity;
  const int32_t* count;   // CUDA: the number of valid ids, in device memory; null: all
  const float* means;     // [N, 3]
  const float* viewmats;  // [B, 4, 4], rigid
  GateRules rules;
};

// The camera centre -R^T t of a rigid pose.
BLITZGS_HD void camera_centre(const float* viewmat, float* centre) {
  for (int axis = 0; axis < 3; ++axis) {
    double sum = 0;
    for (int i = 0; i < 3; ++i) sum -= double(viewmat[4 * i + axis]) * double(viewmat[4 * i + 3]);
    centre[axis] = float(sum);
  }
}

BLITZGS_HD float squared_distance(const float* a, const float* b) {
  float sum = 0;
  for (int axis = 0; axis < 3; ++axis) sum += (a[axis] - b[axis]) * (a[axis] - b[axis]);
  return sum;
}

BLITZGS_HD bool has_bit(uint32_t bits, int index) { return (bits >> index & 1u) != 0; }

BLITZGS_HD float reach2_of(const GateRules& rules, const GateTable& table, int64_t row) {
  const int level = rules.level[row], last = rules.n_levels - 1;
  return table.reach2[level < last ? level : last];
}

BLITZGS_HD uint32_t views_that_cull(const GateRules& rules, const GateTable& table, int64_t row,
                                    uint32_t seen) {
  uint32_t culled = 0;
  if (!(seen & rules.cull_views)) return culled;
  for (int view = 0; view < rules.n_views; ++view) {
    if (!has_bit(seen & rules.cull_views, view)) continue;
    if (sector_bit(rules.cull, rules.cull_columns, table.columns[view], row)) culled |= 1u << view;
  }
  return culled;
}

BLITZGS_HD void gate_entry(const ViewGateArgs& args, const GateTable& table, int64_t i) {
  const GateRules& rules = args.rules;
  const int64_t row = args.ids[i];
  const auto seen = uint32_t(args.views[i]);
  uint32_t kept = seen & ~views_that_cull(rules, table, row, seen);
  if (kept & rules.lod_views) {
    const float reach2 = reach2_of(rules, table, row);
    for (int view = 0; view < rules.n_views; ++view) {
      if (!has_bit(kept & rules.lod_views, view)) continue;
      if (squared_distance(args.means + 3 * row, table.centres[view]) > reach2) kept &= ~(1u << view);
    }
  }
  if (kept != seen) args.views[i] = int32_t(kept);
}

// Fills `table` with the table of the rules and the camera centres. Each thread does a level and a view.
BLITZGS_HD void fill_gate_table(const GateRules& rules, const float* viewmats, int thread, GateTable& table) {
  if (thread < kMaxLevels) table.reach2[thread] = rules.table.reach2[thread];
  if (thread < rules.n_views) {
    table.columns[thread] = rules.table.columns[thread];
    camera_centre(viewmats + 16 * thread, table.centres[thread]);
  }
}

namespace BLITZGS_BACKEND {
void sectors_of_rows(const CullMask&, CudaStream);
void rows_of_sectors(const CullMask&, CudaStream);
void gate_views(const ViewGateArgs&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
