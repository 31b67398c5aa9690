// SPDX-License-Identifier: Apache-2.0
// The active set of a step: the rows of the table that some view may see, without reading most others.
//
// The table is in Morton order, so consecutive rows are neighbours in space. A block is 256 consecutive rows.
// Its bounds contain every position and size that its Gaussians can have while steps of the lazy optimiser
// are pending: a row then moves along a straight line, by at most m / sqrt(v) times the tail of the schedule
// (lazy_adam.h), so its mean lies in the box of this line, and its log scales between two values.
//
// A box of means with standard deviations up to sigma is dropped from a view iff all its points fail one of
// the inequalities of the view's frustum (math/frustum.h). Blocks are tested first, then the rows of the
// remaining blocks, each with the box of its own line. The test of a block has twice the rounding slack, so a
// row that passes its own test is never dropped with its block, and the result does not depend on how rows
// are grouped. If the box of a block satisfies all inequalities with sigma = 0 and some slack, all its rows
// pass unread. Only the rows of mixed blocks, which lie across a border of a view, are read.
//
// A gate on the views (view_gate.h) drops rows by the same principle, by the distances of a box from the
// camera. A row for which they do not decide stays active; the exact test follows when the row has caught up.
//
// The test is conservative: every row that the projection would project is in the set. The cost is
// O(N / 256 + rows of mixed blocks + active rows) per view, the memory O(rows of the blocks that some view
// may see). The caller gives a capacity in blocks. If more are active, the lists are empty; n_blocks says so.
#pragma once
#include <cfloat>

#include "active/view_gate.h"
#include "adam/lazy_adam.h"
#include "math/frustum.h"

namespace blitzgs {

constexpr int kBlockBounds = 8;  // lowest corner, highest corner, largest sigma, whether all rows are finite

BLITZGS_HD int rows_in_block(int64_t rows, int64_t block) {
  const int64_t rest = rows - block * kBlockRows;
  return int(rest < kBlockRows ? rest : kBlockRows);
}

// The columns of the table that say where rows are and where pending steps may move them. Moments null: no
// row has pending steps.
struct BlockRows {
  const float *means, *scales;  // [N, 3], scales logarithmic
  const float *exp_avg_means, *exp_avg_sq_means, *exp_avg_scales, *exp_avg_sq_scales;
  const int32_t *last_step, *moment_step;  // [N], the steps of parameters and moments (lazy_adam.h)
  const double* table;                     // [S + 1, kAdamTable]
  int64_t n;
};

// A box of means and an upper bound on the standard deviations; empty if low > high.
struct SweptBox {
  float low[3], high[3], sigma;
};

BLITZGS_HD SweptBox empty_box() {
  return {{FLT_MAX, FLT_MAX, FLT_MAX}, {-FLT_MAX, -FLT_MAX, -FLT_MAX}, 0.0f};
}

// The drift by a row's pending steps, with a margin for rounding.
BLITZGS_HD float pending_drift(float m, float v, float tail) {
  return m == 0.0f || !(v > 0.0f) ? 0.0f : m / std::sqrt(v) * tail * 1.00001f;
}

// The box in which a row stays while its steps are pending. That of a row that is not finite is empty.
BLITZGS_HD SweptBox sweep_row(const BlockRows& rows, int64_t row) {
  SweptBox box = empty_box();
  // All values whose address depends on the row alone are loaded before the first computation, so that a GPU
  // waits once for all of these loads.
  const bool pending = rows.exp_avg_means != nullptr;
  const int32_t stand = pending ? rows.last_step[row] : 0;
  const int32_t behind = pending ? stand - rows.moment_step[row] : 0;
  float mean[3], scale[3], moments[2][3], squares[2][3];
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t at = 3 * row + axis;
    mean[axis] = rows.means[at], scale[axis] = rows.scales[at];
    moments[0][axis] = pending ? rows.exp_avg_means[at] : 0.0f;
    squares[0][axis] = pending ? rows.exp_avg_sq_means[at] : 0.0f;
    moments[1][axis] = pending ? rows.exp_avg_scales[at] : 0.0f;
    squares[1][axis] = pending ? rows.exp_avg_sq_scales[at] : 0.0f;
  }
  float mean_tail = 0.0f, scale_tail = 0.0f;
  if (pending) {
    const double* entry = rows.table + int64_t(stand) * kAdamTable;
    const double decay = rows.table[int64_t(behind) * kAdamTable + kRatioPower];
    mean_tail = float(decay * entry[kTails]);
    scale_tail = float(decay * entry[kTails + 2]);
  }
  SweptBox swept;
  float largest = -FLT_MAX, check = 0.0f;
  for (int axis = 0; axis < 3; ++axis) {
    const float end = mean[axis] - pending_drift(moments[0][axis], squares[0][axis], mean_tail);
    const float shrunk = scale[axis] - pending_drift(moments[1][axis], squares[1][axis], scale_tail);
    swept.low[axis] = mean[axis] < end ? mean[axis] : end;
    swept.high[axis] = mean[axis] < end ? end : mean[axis];
    largest = scale[axis] > largest ? scale[axis] : largest;
    largest = shrunk > largest ? shrunk : largest;
    check += (end - end) + (shrunk - shrunk);
  }
  if (!(check == 0.0f)) return box;
  swept.sigma = std::exp(largest) * 1.00001f;
  return swept;
}

BLITZGS_HD void extend(SweptBox& box, const SweptBox& other) {
  for (int axis = 0; axis < 3; ++axis) {
    box.low[axis] = other.low[axis] < box.low[axis] ? other.low[axis] : box.low[axis];
    box.high[axis] = other.high[axis] > box.high[axis] ? other.high[axis] : box.high[axis];
  }
  box.sigma = other.sigma > box.sigma ? other.sigma : box.sigma;
}

BLITZGS_HD bool is_empty(const SweptBox& box) { return box.low[0] > box.high[0]; }

BLITZGS_HD void store_bounds(const SweptBox& box, bool all_finite, float* bounds) {
  for (int axis = 0; axis < 3; ++axis) bounds[axis] = box.low[axis], bounds[3 + axis] = box.high[axis];
  bounds[6] = box.sigma;
  bounds[7] = all_finite ? 1.0f : 0.0f;
}

BLITZGS_HD SweptBox load_box(const float* bounds) {
  return {{bounds[0], bounds[1], bounds[2]}, {bounds[3], bounds[4], bounds[5]}, bounds[6]};
}

struct CullCamera {
  const float *viewmats, *Ks;  // [B, 4, 4], [B, 3, 3]
  int width, height;
  float near_plane, far_plane, eps2d;
};

BLITZGS_HD Frustum make_frustum(const CullCamera& args, int view) {
  const Camera<float> camera =
      make_camera(args.viewmats + 16 * view, args.Ks + 9 * view, args.width, args.height);
  return make_frustum(camera, args.width, args.height, args.near_plane, args.far_plane, args.eps2d);
}

// any: a view may see a part of a box. all: the view certainly sees all means in the box.
struct Visibility {
  bool any, all;
};

// Tests a box against the planes of a view. slack: the largest relative rounding error of each term.
BLITZGS_HD Visibility visibility_of(const Frustum& view, const SweptBox& box, float slack) {
  float centre[3], half[3];
  for (int axis = 0; axis < 3; ++axis) {
    centre[axis] = 0.5f * box.low[axis] + 0.5f * box.high[axis];
    half[axis] = 0.5f * box.high[axis] - 0.5f * box.low[axis];
    if (half[axis] < 0.0f) return {false, false};  // empty
    half[axis] += slack * (std::fabs(centre[axis]) + half[axis]);
  }
  Visibility visibility{true, true};
  for (int i = 0; i < kFrustumPlanes; ++i) {
    const FrustumPlane& plane = view.planes[i];
    float value = plane.d, reach = slack * std::fabs(plane.d);
    for (int axis = 0; axis < 3; ++axis) {
      value += plane.n[axis] * centre[axis];
      reach += std::fabs(plane.n[axis]) * half[axis];
    }
    if (value + reach + plane.k * box.sigma < 0.0f) visibility.any = false;
    if (!(value - reach >= 0.0f)) visibility.all = false;
  }
  return visibility;
}

constexpr float kRowSlack = kPointSlack, kBlockSlack = 2 * kPointSlack;

// The gate of the views (view_gate.h) for blocks and for rows that have not caught up. A row is dropped only
// if the exact test would drop it wherever it may be. Without rules no row is dropped.
struct BlockGate {
  GateRules rules;
  const uint8_t* level_ranges;  // [blocks_of(n), 2], coarsest and finest level of each block
};

// Bounds on the squared distances of all points of a box from a camera.
struct DistanceRange {
  float near2, far2;
};

BLITZGS_HD DistanceRange distances_of(const SweptBox& box, const float* centre, float slack) {
  DistanceRange range{0.0f, 0.0f};
  for (int axis = 0; axis < 3; ++axis) {
    const float middle = 0.5f * box.low[axis] + 0.5f * box.high[axis];
    float half = 0.5f * box.high[axis] - 0.5f * box.low[axis];
    half += slack * (std::fabs(middle) + half + std::fabs(centre[axis]));
    const float offset = std::fabs(centre[axis] - middle);
    const float gap = offset > half ? offset - half : 0.0f;
    range.near2 += gap * gap;
    range.far2 += (offset + half) * (offset + half);
  }
  return {range.near2 * (1.0f - 4.0f * slack), range.far2 * (1.0f + 4.0f * slack)};
}

// One bit for each view. any: the view may see a row of the block. inside: the view's frustum certainly
// contains all rows. all: in addition, neither the LOD gate nor the cull mask drops one of them.
struct BlockViews {
  uint32_t any, inside, all;
};

// Removes from `seen` the views in which the gate drops all rows (any) or may drop a row (all).
BLITZGS_HD void gate_block(const BlockGate& gate, const GateTable& table, int64_t block, const SweptBox& box,
                           BlockViews& seen) {
  const GateRules& rules = gate.rules;
  const int last = rules.n_levels - 1;
  const int coarsest = gate.level_ranges[2 * block], finest = gate.level_ranges[2 * block + 1];
  for (int view = 0; view < rules.n_views; ++view) {
    if (!has_bit(seen.any & rules.lod_views, view)) continue;
    const DistanceRange range = distances_of(box, table.centres[view], kBlockSlack);
    const uint32_t others = ~(1u << view);
    if (range.near2 > table.reach2[coarsest < last ? coarsest : last]) seen.any &= others;
    if (!(range.far2 <= table.reach2[finest < last ? finest : last])) seen.all &= others;
  }
  for (int view = 0; view < rules.n_views; ++view) {
    if (!has_bit(seen.any & rules.cull_views, view)) continue;
    const int64_t sector = sector_at(block, rules.cull_columns, table.columns[view]);
    const SectorBits culled = sector_bits(rules.cull + sector, rows_in_block(rules.n_rows, block));
    if (culled.all) seen.any &= ~(1u << view);
    if (culled.any) seen.all &= ~(1u << view);
  }
  seen.inside &= seen.any;
  seen.all &= seen.any;
}

// The test of a block from its bounds [kBlockBounds].
template <bool kGated>
BLITZGS_HD BlockViews views_of_block(const Frustum* views, int count, const float* bounds, int64_t block,
                                     const BlockGate& gate, const GateTable& table) {
  const SweptBox box = load_box(bounds + block * kBlockBounds);
  BlockViews result{0, 0, 0};
  for (int view = 0; view < count; ++view) {
    const Visibility visibility = visibility_of(views[view], box, kBlockSlack);
    if (visibility.any) result.any |= 1u << view;
    if (visibility.any && visibility.all) result.inside |= 1u << view;
  }
  if (bounds[block * kBlockBounds + 7] == 0.0f) result.inside = 0;
  result.all = result.inside;
  if (kGated) gate_block(gate, table, block, box, result);
  return result;
}

// Whether the block's rows have to be tested one by one.
BLITZGS_HD bool is_mixed(const BlockViews& block) { return block.any != block.all; }

// The views that may see a row of a mixed block, as bits. The row's columns are read only if the bounds of
// its block do not decide.
template <bool kGated>
BLITZGS_HD uint32_t views_of_row(const BlockRows& rows, const Frustum* views, int count, const float* bounds,
                                 const BlockViews& seen, int64_t row, const BlockGate& gate,
                                 const GateTable& table) {
  uint32_t mask = seen.any, by_level = 0;
  float reach2 = 0.0f;
  if (kGated) {
    mask &= ~views_that_cull(gate.rules, table, row, mask);
    if (mask & gate.rules.lod_views) {
      const SweptBox block = load_box(bounds + row / kBlockRows * kBlockBounds);
      reach2 = reach2_of(gate.rules, table, row);
      for (int view = 0; view < count; ++view) {
        if (!has_bit(mask & gate.rules.lod_views, view)) continue;
        const DistanceRange range = distances_of(block, table.centres[view], kBlockSlack);
        if (range.near2 > reach2) {
          mask &= ~(1u << view);
        } else if (!(range.far2 <= reach2)) {
          by_level |= 1u << view;
        }
      }
    }
  }
  const uint32_t by_frustum = mask & ~seen.inside;
  if (!(by_frustum | by_level)) return mask;
  const SweptBox box = sweep_row(rows, row);
  for (int view = 0; view < count; ++view) {
    bool dropped = has_bit(by_frustum, view) && !visibility_of(views[view], box, kRowSlack).any;
    if (kGated && !dropped && has_bit(by_level, view)) {
      dropped = distances_of(box, table.centres[view], kRowSlack).near2 > reach2;
    }
    if (dropped) mask &= ~(1u << view);
  }
  return mask;
}

struct alignas(16) ActiveBlock {
  int32_t block;
  BlockViews seen;
};

// The result of the tests, from which the rows are listed, for at most capacity_blocks blocks.
struct CullPlan {
  ActiveBlock* blocks;  // the blocks that some view may see, in order
  uint32_t* masks;      // [blocks, kBlockRows], the views that may see each row of a mixed block, as bits
  int32_t* active;      // the number of active rows of each block
  int64_t capacity_blocks;

  CullPlan(int64_t n_blocks, Workspace& workspace)
      : blocks(workspace.allocate<ActiveBlock>(n_blocks)),
        masks(workspace.allocate<uint32_t>(n_blocks * kBlockRows)),
        active(workspace.allocate<int32_t>(n_blocks)),
        capacity_blocks(n_blocks) {}
};

// The output: the active rows and the views that may see each (as bits), in lists for capacity_blocks blocks,
// of which the first *count entries are valid. *n_blocks is the number of blocks that some view may see; if
// it exceeds `capacity_blocks`, *count is 0.
struct ActiveList {
  int32_t *ids, *views, *count, *n_blocks;  // [capacity_blocks * kBlockRows] twice, [1] twice
  int64_t capacity_blocks;
};

struct CullInputs {
  BlockRows rows;
  const float* bounds;
  CullCamera camera;
  int views;
  BlockGate gate;
};

namespace BLITZGS_BACKEND {
// keys [n]: the Morton codes (math/morton.h) of points [n, 3], without their lowest bit so that they fit a
// signed integer. A table whose rows are in this order has neighbours in space in neighbouring rows.
void morton_keys(const float* points, int64_t n, int64_t* keys, Workspace&, CudaStream);
// Computes the bounds of the blocks that contain the rows `ids`, or of all blocks if ids is null.
void update_block_bounds(const BlockRows& rows, const int32_t* ids, int64_t n_ids, float* bounds, Workspace&,
                         CudaStream);
// Waits for the number of blocks that some view may see.
int64_t count_active_blocks(const CullInputs&, Workspace&, CudaStream);
void cull_blocks(const CullInputs&, const ActiveList&, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
