// SPDX-License-Identifier: Apache-2.0
// Projection: N Gaussians and B views to rows, one for each Gaussian that a view sees. The arithmetic of one
// row is project_row.h.
//
// A row exists iff near < z <= far, its opacity (compensated when antialiased) is >= 1/255, the box around
// alpha >= 1/255 overlaps the image and reaches beyond radius_clip, its view is in the candidate's mask, and
// its geometry is finite: a NaN or infinite parameter hides its Gaussian and spreads nowhere. With
// radius_clip = 0 no dropped row could have changed a pixel. A row whose colour is not finite is there but
// hidden: opacity, colour, radii and tiles_touched are 0, so nothing composites it (SH rows are by far the
// most bytes, and are read once, for rows alone).
//
// Rows are ordered by (Gaussian, view). Every value of a row depends on its Gaussian and view alone, so rows
// are bit-identical however Gaussians are divided among calls. O(candidates * B + rows); no output of size N.
//
// On the CPU project_count projects and sums up what there will be, project_list writes which Gaussian and
// view each row is of, and project_emit the rows. On CUDA project_survey lists, from few bytes per candidate,
// the views that may see it; project_rows projects those pairs, counts what are rows and, as far as it was
// given room for them, writes each behind those before it, in one launch: where the room turns out to be too
// small, it runs again. project_colors adds the colours. Nobody waits for the device: kernels find the sums
// there.
//
// On several ranks, rank_tiles says which tiles each composites. The walk over a row's tiles that counts them
// then also finds the ranks that the row has to reach.
//
// project_bwd visits each visible Gaussian once, recomputes its rows and sums their gradients in row order:
// no atomics, deterministic. The pose gradient is summed in double over fixed blocks of Gaussians.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/stream.h"
#include "math/rank_tiles.h"
#include "project/project_row.h"
#include "project/row_gradients.h"
#include "scatter/scatter.h"

namespace blitzgs {

// means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3] or null; viewmats [B, 4, 4],
// Ks [B, 3, 3]. Candidates: rows active_ids (ascending), or all N when null; bit v of active_views[c] allows
// view v for candidate c (null: all views). n_active (CUDA, on the device): how many of the n_candidates
// there are; null: all.
template <class T>
struct ProjectInputs {
  const T *means, *quats, *scales, *opacities, *sh, *viewmats, *Ks;
  const std::int32_t *active_ids, *active_views;
  std::int64_t n_candidates;
  int n_views;
  ProjectOptions<T> options;
  const std::int32_t* n_active = nullptr;
};

// What project_count sums up, int64 [project_totals(...)], where the inputs are: U visible Gaussians, P rows,
// the tiles they touch (an upper bound: hidden rows count), the rows of each view [B], and for each rank its
// rows and the tiles they touch there [M, 2].
inline constexpr int kTotalVisible = 0, kTotalRows = 1, kTotalTiles = 2, kTotalViews = 3;

inline std::int64_t project_totals(std::int64_t n_views, std::int64_t n_ranks) {
  return kTotalViews + n_views + 2 * n_ranks;
}

inline constexpr std::int64_t kProjectBlock = 1024;

inline std::int64_t project_blocks(std::int64_t items) { return (items + kProjectBlock - 1) / kProjectBlock; }

// Visible Gaussians and rows.
struct ProjectSizes {
  std::int64_t visible, rows;
};

// How many there is room for, and what there is, as project_totals where the inputs are; null: the room is
// what is needed, as always on the CPU.
struct ProjectRoom {
  ProjectSizes sizes;
  const std::int64_t* totals;
};

// Which Gaussian and view each row is of, and where the rows of each visible Gaussian begin: [P], [P], [U],
// [U + 1].
struct ProjectIds {
  std::int32_t *gaussian_ids, *camera_ids, *visible_ids, *row_offsets;
};

// colors is null without sh, rank_masks (bit m: rank m composites tiles of the row) without ranks. row_ids:
// the persistent ids of the rows' Gaussians, from those of all, ids [N]; null: not wanted.
template <class T>
struct ProjectOutputs {
  T *means2d, *conics, *depths, *opacities, *colors;
  std::int32_t *radii, *tiles_touched;
  std::int64_t *rank_masks, *row_ids;
  const std::int64_t* ids;
};

// What other ranks need of a row: means2d, conics, opacities, colors, depths, camera_ids and the Gaussian's
// persistent id, in words.
inline constexpr RowColumns<const std::int32_t> kEmittedColumns{{}, {0, 2, 5, 6, 9, 10, 11, 13}, 7};
inline constexpr int kOpacityColumn = 2, kColorColumn = 3;

// What this rank writes to the others, as its device works it out.
struct ProjectAdmitted {
  std::int64_t received;  // rows that arrive here: the first word, for what takes that number on the device
  ProjectSizes sizes;
  RowGroups groups;                // rows for each rank, and the row of its target that they begin at
  std::int64_t filled[kMaxRanks];  // how many of these have been given a place
};

// Where rows go besides (CUDA): each to the ranks of its rank mask, as `scatter` does (scatter/scatter.h), in
// every target behind the rows of the ranks before this one, unless some rank has more than `capacity` rows,
// of its own, to send or to get: then nothing is written, here and, as all ranks know of it, at no other.
// everyone: project_totals of each rank, on the device. targets: where the columns of each rank's rows begin.
// admitted and places are written too.
struct ProjectScatter {
  ProjectAdmitted* admitted;
  RowPlace* places;
  const std::int64_t* everyone;
  int n_ranks, rank;
  std::int64_t capacity;
  ScatterTargets targets;
  bool with_colors;  // else they follow: project_colors_to_ranks
};

// Gradients by visible Gaussian, [U, ...] (sh [U, K, 3], null without sh), or, where `dense`, by Gaussian:
// [N, ...], zeros, of which the rows of the visible are written. viewmats [B, 4, 4] or null.
template <class T>
struct ProjectGradients {
  T *means, *quats, *scales, *opacities, *sh, *viewmats;
  bool dense = false;
};

// What the backward pass knows of the forward pass.
struct ProjectRows {
  const std::int32_t *camera_ids, *visible_ids, *row_offsets;
  std::int64_t n_visible;
};

namespace cpu {
// plan [project_plan_bytes] is the backend's own, from count to emit. So is what count puts into `carry` (the
// CPU: its rows, which it need not compute twice; CUDA: nothing): one allocation at most, which emit gets
// back.
std::size_t project_plan_bytes(std::int64_t candidates);
template <class T>
void project_count(const ProjectInputs<T>&, const RankTiles& rank_tiles, void* plan, Workspace& carry,
                   std::int64_t* totals, Workspace&, CudaStream);
template <class T>
void project_list(const ProjectInputs<T>&, const void* plan, const ProjectRoom&, const ProjectIds&,
                  Workspace&, CudaStream);
template <class T>
void project_emit(const ProjectInputs<T>&, const RankTiles&, const void* carry, const ProjectIds&,
                  const ProjectRoom&, const ProjectOutputs<T>&, Workspace&, CudaStream);
// scale_reg [B] or null: adds scale_reg[b] * d(min_j s_j) for each row in view b (the paper's L_scale).
template <class T>
void project_bwd(const ProjectInputs<T>&, const ProjectRows&, const ProjectRowGradients<T>&,
                 const T* scale_reg, const ProjectGradients<T>&, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
// plan [project_plan_bytes]: from the survey to the rows.
std::size_t project_plan_bytes(std::int64_t candidates);
void project_survey(const ProjectInputs<float>&, void* plan, Workspace&, CudaStream);
// totals: null, where they are known. With no room rows are counted only.
void project_rows(const ProjectInputs<float>&, const RankTiles&, const void* plan, const ProjectSizes& room,
                  const ProjectIds&, const ProjectOutputs<float>&, std::int64_t* totals, Workspace&,
                  CudaStream);
// Of the rows that project_rows wrote; none without sh. beside: leaves a place to kernels of other streams.
void project_colors(const ProjectInputs<float>&, const ProjectIds&, const ProjectRoom&,
                    const ProjectOutputs<float>&, CudaStream, bool beside = false);
// Into the room for `capacity` rows that this rank has too.
void project_rows_to_ranks(const ProjectIds&, const ProjectOutputs<float>&, int n_views,
                           const ProjectScatter&, CudaStream);
// The colours of rows that were sent without: nobody needs them to sort the rows, so they are worked out
// while the rows travel, and travel while these are sorted. A row whose colour is not finite is hidden only
// now: its opacity becomes zero where it went too, which may list it, but composites nothing of it.
void project_colors_to_ranks(const ProjectOutputs<float>&, const ProjectScatter&, CudaStream);
template <class T>
void project_bwd(const ProjectInputs<T>&, const ProjectRows&, const RowGradientSource&, const T* scale_reg,
                 const ProjectGradients<T>&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
