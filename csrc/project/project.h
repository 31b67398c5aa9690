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
#include <variant>

#include "common/kernel.h"
#include "lazy_adam/lazy_adam.h"
#include "math/tiles.h"
#include "project/project_splat.h"
#include "scatter/scatter.h"

// Smooth levels: the opacity of a Gaussian fades out towards the distance beyond which a view leaves out its
// octree level (view_gate.h), where the LOD gate alone would cut it off.
//
// weight(d) = clamp((1 - d^2 / reach^2) f / (f - 1), 0, 1) for a mean at distance d from the camera: 0 from
// `reach` on, 1 up to reach / sqrt(f), which is half a level nearer. Everything fainter by it follows from
// the faded opacity: the alpha of a pixel, which splats exist, and which tiles they touch. What the gate
// leaves out has the weight 0, so the gate before the projection saves work and changes nothing.
//
// A weight is a constant for the gradient of means and poses: it says what a view shows, not where the
// scene is. The opacity's gradient has it as a factor.

namespace blitzgs {

struct LevelFade {
  const std::uint8_t* level;         // [N]; null: nothing fades
  int n_levels;                      // a level beyond the last counts as the last
  float inverse_reach2[kMaxLevels];  // 1 / reach^2; 0: kept at any distance
};

BLITZGS_HD float inverse_reach2_of(const LevelFade& fade, std::int64_t id) {
  if (!fade.level) return 0.0f;
  const int level = fade.level[id], last = fade.n_levels - 1;
  return fade.inverse_reach2[level < last ? level : last];
}

// Where the projection's backward pass finds the gradients of the splats. Each source has the same three
// members, for splat r: geometry(r), color(r), and whether there are colours at all.

// In columns: [P, 2], [P, 3], [P], [P], [P, 3]; depths and colors may be null (zero).
template <class T>
struct SplatGradientColumns {
  const T *means2d, *conics, *depths, *opacities, *colors;

  BLITZGS_HD bool colored() const { return colors != nullptr; }
  BLITZGS_HD GeometryGradient<T> geometry(std::int64_t r) const {
    return {{means2d[2 * r], means2d[2 * r + 1]},
            {conics[3 * r], conics[3 * r + 1], conics[3 * r + 2]},
            depths ? depths[r] : T(0),
            opacities[r]};
  }
  BLITZGS_HD Vec3<T> color(std::int64_t r) const { return load3(colors + 3 * r); }
};

// In the table that the rasteriser's backward pass adds them up in.
struct PackedSplatGradients {
  const SplatGradient* splats;

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD GeometryGradient<float> geometry(std::int64_t r) const {
    const SplatGradient& v = splats[r];
    return {{v.mean2d[0], v.mean2d[1]}, {v.conic[0], v.conic[1], v.conic[2]}, 0.f, v.opacity};
  }
  // By member, so that the compiler knows the alignment.
  BLITZGS_HD Vec3<float> color(std::int64_t r) const {
    const SplatGradient& v = splats[r];
    return {v.color[0], v.color[1], v.color[2]};
  }
};

// In such tables of all ranks that composited the splats (CUDA), added up in the order of ranks. The memory
// is shared: `tables` are mapped here, each from this rank's first splat on.
struct RankSplatGradients {
  const SplatPlace* places;
  int n_ranks;
  const SplatGradient* tables[kMaxPeers];
  std::int32_t sizes[kMaxPeers];  // this rank's splats in each
  float* means2d;                 // null, or [P, 2]: where the projection's backward pass leaves these sums
  bool absolute;                  // those of mean2d_abs instead

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD GeometryGradient<float> geometry(std::int64_t r) const {
    const SplatGradient splat = sum(r);
    return PackedSplatGradients{&splat}.geometry(0);
  }
  BLITZGS_HD Vec3<float> color(std::int64_t r) const {
    const SplatGradient splat = sum(r);
    return PackedSplatGradients{&splat}.color(0);
  }
  BLITZGS_HD SplatGradient sum(std::int64_t r) const {
    SplatGradient sum{};
    for (int m = 0; m < n_ranks; ++m) {
      const SplatGradient* splat = at(m, r);
      if (!splat) continue;
      const SplatGradient v = *splat;
      sum.add(v);
    }
    return sum;
  }
  // The splat at rank m; null: that composited none of it.
  BLITZGS_HD const SplatGradient* at(int m, std::uint64_t r) const {
    const SplatPlace place = places[r / kPlaceSplats * n_ranks + m];
    const auto in_run = static_cast<std::uint32_t>(r % kPlaceSplats);
    const std::int64_t splat = place.of(in_run);
    return place.has(in_run) && splat < sizes[m] ? tables[m] + splat : nullptr;
  }
};

// One that a kernel on CUDA reads; the CPU reads columns.
using SplatGradientSource =
    std::variant<SplatGradientColumns<float>, PackedSplatGradients, RankSplatGradients>;

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

// The projection's backward pass and the optimiser's step of the visible Gaussians in one: what project_bwd
// and lazy_adam do one after the other, but for the gradients, which need never be stored. Parameters are
// raw, with SH; `adam` lists splats.visible_ids and has no gradients; the listed rows' parameters stand at
// adam.step - 1.

// Gradients of the visible Gaussians in scratch memory, which `adam` is then given.
template <class T>
ProjectGradients<T> scratch_gradients(const SplatIndex& splats, AdamArgs<T>& adam, Workspace& workspace) {
  T* slots[kAdamColumns];
  for (int c = 0; c < kAdamColumns; ++c) {
    slots[c] = workspace.allocate<T>(splats.n_visible * adam.columns[c].width);
    adam.columns[c].grad = slots[c];
  }
  return {slots[0], slots[1], slots[2], slots[3], slots[4], nullptr};
}

namespace cpu {
template <class T>
void project_bwd_step(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientColumns<T>&,
                      const Regularisers<T>&, AdamArgs<T> adam, Workspace&, CudaStream);
}  // namespace cpu
namespace cuda {
template <class T>
void project_bwd_step(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientSource&,
                      const Regularisers<T>&, AdamArgs<T> adam, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
