// SPDX-License-Identifier: Apache-2.0
// Projection: N Gaussians and B views to splats, one for each Gaussian that a view sees. The arithmetic of
// one splat is project_splat.h.
//
// A splat exists iff near < z <= far, its opacity (compensated when antialiased) is >= 1/255, the box around
// alpha >= 1/255 overlaps the image and reaches beyond radius_clip, its view is in the candidate's mask, and
// its geometry is finite: a NaN or infinite parameter hides its Gaussian and spreads nowhere. With
// radius_clip = 0 no dropped splat could have changed a pixel. A splat whose colour is not finite is there
// but hidden: opacity, colour, radii and tiles_touched are 0, so nothing composites it (SH rows are by far
// the most bytes, and are read once, for splats alone).
//
// Splats are ordered by (Gaussian, view). Every value of a splat depends on its Gaussian and view alone, so
// splats are bit-identical however Gaussians are divided among calls. O(candidates * B + splats); no output
// of size N.
//
// project() counts the splats and writes them, by three kernels on CUDA: the prefilter lists, from few bytes
// per candidate, the views that may see it; write_splats projects those pairs, counts what are splats and
// writes each behind those before it, in one launch; write_colors adds the colours. With a capacity given,
// CUDA does all of that without waiting for the number of splats; without one it waits for the number and
// then writes.
//
// On several ranks, rank_tiles says which tiles each composites. The walk over a splat's tiles that counts
// them then also finds the ranks that the splat has to reach.
//
// project_bwd visits each visible Gaussian once, recomputes its splats and sums their gradients in splat
// order: no atomics, deterministic. The pose gradient is summed in double over fixed blocks of Gaussians.
#pragma once
#include <cstddef>
#include <cstdint>

#include "common/stream.h"
#include "math/rank_tiles.h"
#include "project/level_fade.h"
#include "project/project_splat.h"
#include "project/splat_gradients.h"

namespace blitzgs {

// means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3] or null; viewmats [B, 4, 4],
// Ks [B, 3, 3]. Candidates: rows active_ids (ascending), or all N when null; bit v of active_views[c] allows
// view v for candidate c (null: all views). n_active (CUDA, on the device): how many of the n_candidates
// there are; null: all. n_blocks (where the inputs are): a number that is passed on to the totals; null: 0.
// fade: of smooth levels.
template <class T>
struct ProjectInputs {
  const T *means, *quats, *scales, *opacities, *sh, *viewmats, *Ks;
  const std::int32_t *active_ids, *active_views;
  std::int64_t n_candidates;
  int n_views;
  ProjectOptions<T> options;
  const std::int32_t* n_active = nullptr;
  LevelFade fade{};
  const std::int32_t* n_blocks = nullptr;
};

// What project() sums up, int64 [project_totals(...)], where the inputs are: U visible Gaussians, P splats,
// the tiles they touch (an upper bound: hidden splats count), the blocks of the table that some view may see
// (blocks.h), the splats of each view [B], and for each rank its splats and the tiles they touch there [M,
// 2].
inline constexpr int kTotalVisible = 0, kTotalSplats = 1, kTotalTiles = 2, kTotalBlocks = 3, kTotalViews = 4;

BLITZGS_HD std::int64_t project_totals(std::int64_t n_views, std::int64_t n_ranks) {
  return kTotalViews + n_views + 2 * n_ranks;
}

inline constexpr std::int64_t kProjectBlock = 1024;

inline std::int64_t project_blocks(std::int64_t items) { return (items + kProjectBlock - 1) / kProjectBlock; }

// Visible Gaussians and splats.
struct ProjectSizes {
  std::int64_t visible, splats;
};

// How many there is room for, and what there is, as project_totals where the inputs are; null: exactly so
// many.
struct ProjectCapacity {
  ProjectSizes sizes;
  const std::int64_t* totals;
};

// Which Gaussian and view each splat is of, and where the splats of each visible Gaussian begin: [P], [P],
// [U], [U + 1].
struct ProjectIds {
  std::int32_t *gaussian_ids, *camera_ids, *visible_ids, *splat_offsets;
};

// colors is null without sh, rank_masks (bit m: rank m composites tiles of the splat) without ranks.
// splat_ids: the persistent ids of the splats' Gaussians, from those of all, ids [N]; null: not wanted.
template <class T>
struct ProjectOutputs {
  T *means2d, *conics, *depths, *opacities, *colors;
  std::int32_t *radii, *tiles_touched;
  std::int64_t *rank_masks, *splat_ids;
  const std::int64_t* ids;
};

// Where project() puts the splats.
template <class T>
struct ProjectColumns {
  ProjectIds ids;
  ProjectOutputs<T> values;
};

// Memory for the splats, from the caller of project().
template <class T>
class SplatMemory {
 public:
  virtual ~SplatMemory() = default;
  // CUDA: splats for which the caller has asked for room before their number is known; null: as many as there
  // are.
  virtual const ProjectSizes* capacity() const = 0;
  // Called once.
  virtual ProjectColumns<T> allocate(const ProjectSizes&) = 0;
};

// Gradients by visible Gaussian, [U, ...] (sh [U, K, 3], null without sh), or, where `dense`, by Gaussian:
// [N, ...], zeros, of which the rows of the visible are written. viewmats [B, 4, 4] or null.
template <class T>
struct ProjectGradients {
  T *means, *quats, *scales, *opacities, *sh, *viewmats;
  bool dense = false;
};

// Terms of the training loss that look at no pixel, as weights per view, [B] each, or null: the loss grows by
// scale[b] times the smallest axis (the paper's L_scale) and by opacity[b] times the opacity of each Gaussian
// that has a splat in view b.
template <class T>
struct Regularisers {
  const T *scale, *opacity;
};

// What the backward pass knows of the forward pass.
struct SplatIndex {
  const std::int32_t *camera_ids, *visible_ids, *splat_offsets;
  std::int64_t n_visible;
};

namespace cpu {
template <class T>
void project(const ProjectInputs<T>&, const RankTiles&, SplatMemory<T>&, std::int64_t* totals, Workspace&,
             CudaStream);
template <class T>
void project_bwd(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientColumns<T>&,
                 const Regularisers<T>&, const ProjectGradients<T>&, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
// Where the splats do not fit into the capacity, the totals are right all the same; the columns then hold the
// first splats without colours.
template <class T>
void project(const ProjectInputs<T>&, const RankTiles&, SplatMemory<T>&, std::int64_t* totals, Workspace&,
             CudaStream);
template <class T>
void project_bwd(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientSource&,
                 const Regularisers<T>&, const ProjectGradients<T>&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
