// SPDX-License-Identifier: Apache-2.0
// Projection: N Gaussians and B views to rows, one for each Gaussian that a view sees. The arithmetic of one
// row is project_row.h.
//
// A row exists iff near < z <= far, its opacity (compensated when antialiased) is >= 1/255, the box around
// alpha >= 1/255 overlaps the image and reaches beyond radius_clip, its view is in the candidate's mask, and
// everything it needs is finite: a NaN or infinite parameter hides its Gaussian and spreads nowhere. With
// radius_clip = 0 no dropped row could have changed a pixel.
//
// Rows are ordered by (Gaussian, view). Every value of a row depends on its Gaussian and view alone, so rows
// are bit-identical however Gaussians are divided among calls. Two passes with one host synchronisation
// between them: project_count finds, in few bytes per candidate, which views see it; project_emit writes
// those rows and evaluates SH for them alone. O(candidates * B + rows); no output of size N.
//
// project_bwd visits each visible Gaussian once, recomputes its rows and sums their gradients in row order:
// no atomics, deterministic. The pose gradient is summed in double over fixed blocks of Gaussians.
#pragma once
#include <cstdint>
#include <memory>

#include "common/stream.h"
#include "project/project_row.h"

namespace blitzgs {

// means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3] or null; viewmats [B, 4, 4],
// Ks [B, 3, 3]. Candidates: rows active_ids (ascending), or all N when null; bit v of active_views[c] allows
// view v for candidate c (null: all views).
template <class T>
struct ProjectInputs {
  const T *means, *quats, *scales, *opacities, *sh, *viewmats, *Ks;
  const std::int32_t *active_ids, *active_views;
  std::int64_t n_candidates;
  int n_views;
  ProjectOptions<T> options;
};

// Whatever else a backend keeps between the passes (the CPU: the rows; CUDA: nothing).
struct ProjectCarry {
  virtual ~ProjectCarry() = default;
};

// What project_count leaves for project_emit. view_masks [candidates]: bit v set iff view v sees it; and the
// visible candidates and rows before each block of kProjectBlock candidates [blocks + 1].
struct ProjectPlan {
  std::uint32_t* view_masks;
  std::int64_t *visible_before, *rows_before;
  std::unique_ptr<ProjectCarry>* carry;
};

inline constexpr std::int64_t kProjectBlock = 1024;

inline std::int64_t project_blocks(std::int64_t items) { return (items + kProjectBlock - 1) / kProjectBlock; }

// Sizes for allocation, on the host: U visible Gaussians, P rows, tiles they touch in all.
struct ProjectCounts {
  std::int64_t visible = 0, rows = 0, tiles = 0;
};

// colors is null without sh. row_offsets [U + 1].
template <class T>
struct ProjectOutputs {
  std::int32_t *gaussian_ids, *camera_ids, *visible_ids, *row_offsets;
  T *means2d, *conics, *depths, *opacities, *colors;
  std::int32_t *radii, *tiles_touched;
};

// Gradients of the rows; v_depths and v_colors may be null (zero).
template <class T>
struct ProjectRowGradients {
  const T *means2d, *conics, *depths, *opacities, *colors;
};

// Gradients by visible Gaussian, [U, ...] (sh [U, K, 3], null without sh); viewmats [B, 4, 4] or null.
template <class T>
struct ProjectGradients {
  T *means, *quats, *scales, *opacities, *sh, *viewmats;
};

// What the backward pass knows of the forward pass.
struct ProjectRows {
  const std::int32_t *camera_ids, *visible_ids, *row_offsets;
  std::int64_t n_visible;
};

namespace cpu {
template <class T>
void project_count(const ProjectInputs<T>&, const ProjectPlan&, ProjectCounts*, Workspace&, CudaStream);
template <class T>
void project_emit(const ProjectInputs<T>&, const ProjectPlan&, const ProjectCounts&, const ProjectOutputs<T>&,
                  Workspace&, CudaStream);
// scale_reg [B] or null: adds scale_reg[b] * d(min_j s_j) for each row in view b (the paper's L_scale).
template <class T>
void project_bwd(const ProjectInputs<T>&, const ProjectRows&, const ProjectRowGradients<T>&,
                 const T* scale_reg, const ProjectGradients<T>&, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
template <class T>
void project_count(const ProjectInputs<T>&, const ProjectPlan&, ProjectCounts*, Workspace&, CudaStream);
template <class T>
void project_emit(const ProjectInputs<T>&, const ProjectPlan&, const ProjectCounts&, const ProjectOutputs<T>&,
                  Workspace&, CudaStream);
template <class T>
void project_bwd(const ProjectInputs<T>&, const ProjectRows&, const ProjectRowGradients<T>&,
                 const T* scale_reg, const ProjectGradients<T>&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
