// SPDX-License-Identifier: Apache-2.0
// Projection (docs/image.md, sections 1, 2 and 4): turns N Gaussians and B views into splats, one for each
// pair of a Gaussian and a view that sees it. project_splat.h holds the arithmetic of one splat, and
// math/projection.h the equations (EWA).
//
// A splat exists iff near < z <= far, its opacity (compensated when antialiased) is >= 1/255, the box around
// alpha >= 1/255 overlaps the image, its larger radius (rounded up) exceeds radius_clip, its view is in the
// candidate's mask, and its geometry is finite. A parameter that is NaN therefore hides its own Gaussian
// alone, and so does an infinite one, except for limits that have a meaning: a scale of 0 and an opacity of
// 1. With radius_clip = 0 no dropped splat could have changed a pixel. A splat whose colour is not finite
// exists, but its opacity, colour, radii and tiles_touched are 0, so the rasteriser skips it: SH rows, most
// of the bytes of a Gaussian, are read once, for existing splats only.
//
// Splats are ordered by (Gaussian, view). Every value of a splat depends on its Gaussian and view alone, so
// splats are bit-identical however Gaussians are divided among calls. The cost is O(candidates * B + splats).
//
// On CUDA, project() launches three kernels:
// 1. prefilter (project_cuda.cu) lists the candidates that some view may see by their means and scales, with
//    those views;
// 2. write_splats (write_splats_cuda.cu) projects the listed pairs, counts those that are splats, and writes
//    the splats in order, in one launch (two without a capacity);
// 3. color_splats (project_cuda.cu) computes the colour of each splat.
//
// project_bwd (project_bwd_device.cuh on CUDA) visits each visible Gaussian once, recomputes its splats and
// sums their gradients in splat order: deterministic, without atomics. It sums the pose gradients of a few
// Gaussians (on the CPU of a block) in T, and these sums in double, in a fixed order.
#pragma once
#include <functional>
#include <variant>

#include "adam/lazy_adam.h"
#include "math/tiles.h"
#include "project/project_splat.h"

// Smooth levels: the LOD gate (view_gate.h) drops an octree level from a view beyond a certain distance, its
// reach. With smooth levels the opacity falls to zero towards this distance, so that Gaussians do not
// disappear from one frame to the next: for a mean at distance d from the camera it is multiplied by
//
//   weight(d) = clamp((1 - d^2 / reach^2) f / (f - 1), 0, 1),
//
// which is 0 from `reach` on and 1 up to reach / sqrt(f), half a level nearer. Alpha, the existence of the
// splat and its tiles follow from this opacity. What the gate drops has the weight 0, so applying the gate
// before the projection changes no pixel. The gradients of means and poses treat the weight as a constant,
// because it does not describe the scene; that of the opacity has it as a factor.

namespace blitzgs {

struct LevelFade {
  const uint8_t* level;              // [N], octree levels; null: nothing fades
  int n_levels;                      // Gaussians of a higher level fade as those of level n_levels - 1
  float inverse_reach2[kMaxLevels];  // by level: 1 / reach^2; 0: the level never fades
};

BLITZGS_HD float inverse_reach2_of(const LevelFade& fade, int64_t id) {
  if (!fade.level) return 0.0f;
  const int level = fade.level[id], last = fade.n_levels - 1;
  return fade.inverse_reach2[level < last ? level : last];
}

// The two sources from which the projection's backward pass reads the gradients of the splats: geometry(r)
// and color(r) are those of splat r, and colored() says whether there are gradients of colours.

// One array for each attribute: [P, 2], [P, 3], [P], [P], [P, 3]. depths and colors may be null (zero).
template <class T> struct SplatGradientColumns {
  const T *means2d, *conics, *depths, *opacities, *colors;

  BLITZGS_HD bool colored() const { return colors != nullptr; }
  BLITZGS_HD GeometryGradient<T> geometry(int64_t r) const {
    return {{means2d[2 * r], means2d[2 * r + 1]},
            {conics[3 * r], conics[3 * r + 1], conics[3 * r + 2]},
            depths ? depths[r] : T(0),
            opacities[r]};
  }
  BLITZGS_HD Vec3<T> color(int64_t r) const { return load3(colors + 3 * r); }
};

// The table [P] in which the rasteriser's backward pass sums the gradients.
struct PackedSplatGradients {
  const SplatGradient* splats;

  BLITZGS_HD bool colored() const { return true; }
  BLITZGS_HD GeometryGradient<float> geometry(int64_t r) const {
    const SplatGradient& v = splats[r];
    return {{v.mean2d[0], v.mean2d[1]}, {v.conic[0], v.conic[1], v.conic[2]}, 0.f, v.opacity};
  }
  // Reads each member by itself, because load3 would hide the alignment of the row from the compiler.
  BLITZGS_HD Vec3<float> color(int64_t r) const {
    const SplatGradient& v = splats[r];
    return {v.color[0], v.color[1], v.color[2]};
  }
};

// The source that the kernels of a backend read. The CPU reads columns only.
#ifdef BLITZGS_BACKEND_CUDA
template <class T> using SplatGradientSource = std::variant<SplatGradientColumns<T>, PackedSplatGradients>;
#else
template <class T> using SplatGradientSource = SplatGradientColumns<T>;
#endif

// means [N, 3], quats [N, 4], scales [N, 3], opacities [N], sh [N, K, 3] or null; viewmats [B, 4, 4], Ks [B,
// 3, 3]. The candidates are the rows active_ids [n_candidates] (ascending), or all N when null, of which
// n_active (CUDA, in device memory; null: all) are valid. Bit v of active_views[c] allows view v for
// candidate c (null: all). n_blocks (in the memory of the inputs) is copied to totals[kTotalBlocks]; null: 0.
template <class T> struct ProjectInputs {
  const T *means, *quats, *scales, *opacities, *sh, *viewmats, *Ks;
  const int32_t *active_ids, *active_views;
  int64_t n_candidates;
  int n_views;
  ProjectOptions<T> options;
  const int32_t* n_active = nullptr;
  LevelFade fade{};
  const int32_t* n_blocks = nullptr;

  BLITZGS_HD Camera<T> camera(int view) const {
    return make_camera(viewmats + 16 * view, Ks + 9 * view, options.width, options.height);
  }
  BLITZGS_HD int64_t candidate_id(int64_t candidate) const {
    return active_ids ? active_ids[candidate] : candidate;
  }
};

// The totals of project(), int64 [project_totals(...)], in the memory of the inputs: U visible Gaussians, P
// splats, the tiles that the splats touch (an upper bound, because hidden splats count), the blocks of the
// table that some view may see (blocks.h), the splats of each view [B], and for each rank the splats that it
// composites and the tiles that these touch there [M, 2].
inline constexpr int kTotalVisible = 0, kTotalSplats = 1, kTotalTiles = 2, kTotalBlocks = 3, kTotalViews = 4;

BLITZGS_HD int64_t project_totals(int64_t n_views, int64_t n_ranks) {
  return kTotalViews + n_views + 2 * n_ranks;
}

inline constexpr int64_t kProjectBlock = 1024;

inline int64_t project_blocks(int64_t items) { return (items + kProjectBlock - 1) / kProjectBlock; }

struct ProjectSizes {
  int64_t visible, splats;
};

// sizes: how many visible Gaussians and splats the columns have memory for. totals: the actual numbers, as
// project_totals in the memory of the inputs; null: the actual numbers equal `sizes`.
struct ProjectCapacity {
  ProjectSizes sizes;
  const int64_t* totals;

  // The actual numbers, or zeros if they exceed the capacity. (CUDA: in a kernel.)
  BLITZGS_HD ProjectSizes fitting() const {
    if (!totals) return sizes;
    const ProjectSizes actual{totals[kTotalVisible], totals[kTotalSplats]};
    return actual.visible <= sizes.visible && actual.splats <= sizes.splats ? actual : ProjectSizes{0, 0};
  }
};

// gaussian_ids [P] and camera_ids [P]: the Gaussian and the view of each splat. visible_ids [U]: the
// Gaussians that have splats. Those of visible_ids[u] begin at splat_offsets[u]; [U + 1].
struct ProjectIds {
  int32_t *gaussian_ids, *camera_ids, *visible_ids, *splat_offsets;
};

// The values of the splats: means2d [P, 2], conics [P, 3], depths [P], opacities [P], colors [P, 3] (null
// without sh), radii [P, 2], tiles_touched [P], rank_masks [P] (bit m: rank m composites tiles of the splat;
// null on one rank). splat_ids [P] takes the persistent ids of the splats' Gaussians from ids [N], those of
// all Gaussians; splat_ids null: not wanted.
template <class T> struct ProjectOutputs {
  T *means2d, *conics, *depths, *opacities, *colors;
  int32_t *radii, *tiles_touched;
  int64_t *rank_masks, *splat_ids;
  const int64_t* ids;
};

template <class T> struct ProjectColumns {
  ProjectIds ids;
  ProjectOutputs<T> values;
};

template <class T> using SplatMemory = std::function<ProjectColumns<T>(const ProjectSizes&)>;

// The outputs of the backward pass: one row for each visible Gaussian, [U, ...] (sh [U, K, 3], null without
// sh), or, with `dense`, one for each Gaussian, [N, ...], which the caller fills with zeros. viewmats [B, 4,
// 4] or null.
template <class T> struct ProjectGradients {
  T *means, *quats, *scales, *opacities, *sh, *viewmats;
  bool dense = false;
};

// Arrays that are set to zero together; on CUDA by one launch, which takes the host microseconds.
template <class T> struct ZeroedArrays {
  static constexpr int kCount = 5;
  T* begin[kCount];
  int64_t length[kCount];
};

// The terms of the training loss that do not depend on pixels, as weights per view, [B] each, or null (zero).
// For each Gaussian that has a splat in view b, the loss has these summands: scale[b] times the smallest axis
// of the Gaussian (BlitzGS, L_scale), and opacity[b] times its opacity (3DGS-MCMC, Kheradmand et al. 2024).
template <class T> struct Regularisers {
  const T *scale, *opacity;
};

// The outputs of the forward pass that the backward pass reads (ProjectIds); n_visible is U.
struct SplatIndex {
  const int32_t *camera_ids, *visible_ids, *splat_offsets;
  int64_t n_visible;
};

// Allocates the gradients of the visible Gaussians in scratch memory and gives them to `adam`.
template <class T>
ProjectGradients<T> scratch_gradients(const SplatIndex& splats, AdamArgs<T>& adam, Workspace& workspace) {
  T* slots[kAdamColumns];
  for (int c = 0; c < kAdamColumns; ++c) {
    slots[c] = workspace.allocate<T>(splats.n_visible * adam.columns[c].width);
    adam.columns[c].grad = slots[c];
  }
  return {slots[0], slots[1], slots[2], slots[3], slots[4], nullptr};
}

namespace BLITZGS_BACKEND {
// Calls `memory` once. capacity (CUDA): chosen before the number of splats is known; null: waits for the
// number and takes memory for exactly as many. If there are more splats, the totals are still correct, and
// the columns hold the first splats, without colours; the caller has to compare the two.
template <class T>
void project(const ProjectInputs<T>&, const RankTiles&, const ProjectSizes* capacity,
             const SplatMemory<T>& memory, int64_t* totals, Workspace&, CudaStream);
// Computes the colours of the splats that project() wrote without `sh`, and hides those whose colour is not
// finite. It reads the means, the SH and the cameras of its inputs, whose rows `gaussian_ids` counts, and
// writes colors, opacities, radii and tiles_touched; other columns may be null. It does nothing if there are
// more splats than the capacity, or no `sh`. On the CPU the sizes of the capacity are the actual numbers.
template <class T>
void color_splats(const ProjectInputs<T>&, const ProjectCapacity&, const ProjectColumns<T>&, CudaStream);
template <class T>
void project_bwd(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientSource<T>&,
                 const Regularisers<T>&, const ProjectGradients<T>&, Workspace&, CudaStream);
template <class T> void zero_arrays(const ZeroedArrays<T>&, CudaStream);
// project_bwd followed by lazy_adam of the visible Gaussians; on CUDA one kernel does both, so that gradients
// need not be written to global memory. Parameters are raw, with SH. `adam` lists splats.visible_ids and has
// no gradients; the listed rows' parameters must have caught up to step adam.step - 1.
template <class T>
void project_bwd_step(const ProjectInputs<T>&, const SplatIndex&, const SplatGradientSource<T>&,
                      const Regularisers<T>&, AdamArgs<T> adam, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
