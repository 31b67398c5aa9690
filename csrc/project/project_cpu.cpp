// SPDX-License-Identifier: Apache-2.0
#include <mutex>
#include <utility>
#include <vector>

#include "common/parallel.h"
#include "project/project.h"

namespace blitzgs::cpu {
namespace {

template <class T> std::vector<Camera<T>> make_cameras(const ProjectInputs<T>& in) {
  std::vector<Camera<T>> cameras;
  for (int view = 0; view < in.n_views; ++view) cameras.push_back(in.camera(view));
  return cameras;
}

template <class T> ActivatedGaussian<T> load_gaussian(const ProjectInputs<T>& in, int64_t id) {
  return activate_gaussian(
      load3(in.means + 3 * id), in.quats + 4 * id, activate_scale(in.scales + 3 * id, in.options.raw),
      activate_opacity(in.opacities[id], in.options.raw), T(inverse_reach2_of(in.fade, id)));
}

// A splat that the counting pass of project() found, kept for the writing pass: the splat, its Gaussian and
// view, the number of its tiles, and the ranks that need it as bits.
template <class T> struct KeptSplat {
  Splat<T> splat;
  int32_t id, view, tiles;
  int64_t ranks;
};

// The result of the counting pass for a block of kProjectBlock candidates: its splats, the number of its
// visible Gaussians, and the numbers of visible Gaussians and splats in all blocks before it.
template <class T> struct CountedBlock {
  std::vector<KeptSplat<T>> splats;
  int64_t visible = 0, visible_before = 0, splats_before = 0;
};

// Projects a candidate into the views that may see it, appends its splats to `splats` and adds to `totals`.
template <class T>
void project_candidate(const ProjectInputs<T>& in, const RankTiles& rank_tiles,
                       const std::vector<Camera<T>>& cameras, const std::vector<Frustum>& frusta,
                       int64_t candidate, std::vector<KeptSplat<T>>* splats, int64_t* totals) {
  const int64_t id = in.candidate_id(candidate);
  const uint32_t allowed = in.active_views ? uint32_t(in.active_views[candidate]) : ~uint32_t{0};
  const Vec3<T> mean = load3(in.means + 3 * id);
  const Vec3<float> point{float(mean.x), float(mean.y), float(mean.z)};
  const float norm = norm1(point);
  uint32_t maybe = 0;
  for (int view = 0; view < in.n_views; ++view) {
    maybe |= uint32_t(may_be_in_depth(frusta[view], point, norm)) << view;
  }
  maybe &= allowed;
  if (maybe == 0) return;
  const Vec3<T> scale = activate_scale(in.scales + 3 * id, in.options.raw);
  const T opacity = activate_opacity(in.opacities[id], in.options.raw);
  if (visible_sigmas(opacity) < T(0)) return;
  // A stored scale may be negative; the Gaussian is that of its absolute value.
  const T widest = larger(larger(std::fabs(scale.x), std::fabs(scale.y)), std::fabs(scale.z));
  const float sigma = opacity <= T(1) ? 1.00001f * float(widest) : kAnyWidth;
  ActivatedGaussian<T> gaussian{};
  const size_t before = splats->size();
  int64_t* by_rank = totals + kTotalViews + in.n_views;
  for (uint32_t rest = maybe, first = 1; rest != 0; rest &= rest - 1) {
    const int view = __builtin_ctz(rest);
    if (!may_overlap(frusta[view], point, norm, sigma)) continue;
    if (first) {
      gaussian =
          activate_gaussian(mean, in.quats + 4 * id, scale, opacity, T(inverse_reach2_of(in.fade, id)));
      first = 0;
    }
    KeptSplat<T> kept{{}, int32_t(id), view, 0, 0};
    if (!project_splat(cameras[view], gaussian, in.options, &kept.splat)) continue;
    kept.tiles = splat_tiles(kept.splat, view, in.options, rank_tiles, &kept.ranks,
                             [&](int rank, int64_t tiles) { by_rank[2 * rank + 1] += tiles; });
    for (int rank = 0; rank < rank_tiles.n_ranks; ++rank) by_rank[2 * rank] += kept.ranks >> rank & 1;
    ++totals[kTotalSplats];
    ++totals[kTotalViews + view];
    totals[kTotalTiles] += kept.tiles;
    splats->push_back(kept);
  }
  totals[kTotalVisible] += splats->size() > before;
}

template <class T>
void write_splat(const ProjectInputs<T>& in, const Camera<T>& camera, int64_t index, const KeptSplat<T>& kept,
                 const ProjectOutputs<T>& out) {
  const Splat<T>& splat = kept.splat;
  const int64_t id = kept.id;
  std::copy_n(splat.mean2d, 2, out.means2d + 2 * index);
  std::copy_n(splat.conic, 3, out.conics + 3 * index);
  out.depths[index] = splat.depth;
  const bool shown =
      !in.sh || splat_color(camera, load3(in.means + 3 * id), in.sh + 3 * in.options.sh_stride * id,
                            in.options.sh_degree, out.colors + 3 * index);
  out.opacities[index] = shown ? splat.opacity : T(0);
  out.radii[2 * index] = shown ? pixel_radius(splat.extent[0]) : 0;
  out.radii[2 * index + 1] = shown ? pixel_radius(splat.extent[1]) : 0;
  out.tiles_touched[index] = shown ? kept.tiles : 0;
  if (out.rank_masks) out.rank_masks[index] = kept.ranks;
  if (out.splat_ids) out.splat_ids[index] = out.ids[id];
}

// Computes the gradients of visible Gaussian u and adds to those of the camera poses, [B] or null.
template <class T>
void gaussian_bwd(const ProjectInputs<T>& in, const std::vector<Camera<T>>& cameras, const SplatIndex& splats,
                  const SplatGradientColumns<T>& v, const Regularisers<T>& regularisers, int64_t u,
                  PoseGradient<T>* poses, const ProjectGradients<T>& out) {
  const int64_t id = splats.visible_ids[u];
  const int64_t stride = 3 * in.options.sh_stride;
  const ActivatedGaussian<T> gaussian = load_gaussian(in, id);
  GaussianGradient<T> gradient{};
  T axis_weight = T(0);
  const int64_t at = out.dense ? id : u;
  if (out.sh) std::fill_n(out.sh + stride * at, stride, T(0));
  for (int64_t r = splats.splat_offsets[u]; r < splats.splat_offsets[u + 1]; ++r) {
    const int view = splats.camera_ids[r];
    PoseGradient<T>* pose = poses ? poses + view : nullptr;
    project_splat_vjp(cameras[view], gaussian, in.options, v.geometry(r), &gradient, pose);
    if (in.sh && v.colored()) {
      splat_color_vjp(cameras[view], gaussian.mean, in.sh + stride * id, in.options.sh_degree,
                      v.colors + 3 * r, out.sh + stride * at, &gradient.mean, pose);
    }
    if (regularisers.scale) axis_weight += regularisers.scale[view];
    if (regularisers.opacity) gradient.opacity += regularisers.opacity[view];
  }
  activate_gaussian_vjp(gaussian, in.options.raw, gradient, axis_weight,
                        {out.means + 3 * at, out.quats + 4 * at, out.scales + 3 * at, out.opacities + at});
}

// Adds the pose gradients [B] of one block to the block's sums [B, 12].
template <class T> void store_poses(const std::vector<PoseGradient<T>>& poses, double* sums) {
  for (const PoseGradient<T>& pose : poses) {
    const Vec3<T> columns[4] = {pose.row_x, pose.row_y, pose.row_z, pose.translation};
    for (const Vec3<T>& column : columns) {
      *sums++ += column.x;
      *sums++ += column.y;
      *sums++ += column.z;
    }
  }
}

template <class T> void reduce_poses(const double* sums, int64_t n_blocks, int n_views, T* v_viewmats) {
  std::fill_n(v_viewmats, 16 * n_views, T(0));
  for (int view = 0; view < n_views; ++view) {
    for (int i = 0; i < 12; ++i) {
      double sum = 0;
      for (int64_t block = 0; block < n_blocks; ++block) sum += sums[(block * n_views + view) * 12 + i];
      const int row = i < 9 ? i / 3 : i - 9, column = i < 9 ? i % 3 : 3;
      v_viewmats[16 * view + 4 * row + column] = T(sum);
    }
  }
}

}  // namespace

template <class T>
void project(const ProjectInputs<T>& in, const RankTiles& rank_tiles, const ProjectSizes*,
             const SplatMemory<T>& memory, int64_t* totals, Workspace&, CudaStream) {
  const std::vector<Camera<T>> cameras = make_cameras(in);
  std::vector<Frustum> frusta;
  for (const Camera<T>& camera : cameras) frusta.push_back(frustum_of(camera, in.options));
  const int64_t n_totals = project_totals(in.n_views, rank_tiles.n_ranks);
  std::vector<CountedBlock<T>> blocks(project_blocks(in.n_candidates));
  std::fill_n(totals, n_totals, 0);
  if (in.n_blocks) totals[kTotalBlocks] = *in.n_blocks;
  std::mutex adding;
  parallel_rows(std::ssize(blocks), 1, [&](int64_t b) {
    CountedBlock<T>& block = blocks[b];
    std::vector<int64_t> sums(n_totals, 0);
    for (int64_t c = b * kProjectBlock; c < std::min(in.n_candidates, (b + 1) * kProjectBlock); ++c) {
      project_candidate(in, rank_tiles, cameras, frusta, c, &block.splats, sums.data());
    }
    block.visible = sums[kTotalVisible];
    const std::lock_guard<std::mutex> lock(adding);
    for (int64_t i = 0; i < n_totals; ++i) totals[i] += sums[i];
  });
  int64_t visible = 0, splats = 0;
  for (CountedBlock<T>& block : blocks) {
    block.visible_before = std::exchange(visible, visible + block.visible);
    block.splats_before = std::exchange(splats, splats + int64_t(block.splats.size()));
  }
  const ProjectColumns<T> columns = memory({visible, splats});
  const ProjectIds& ids = columns.ids;
  ids.splat_offsets[visible] = int32_t(splats);
  parallel_rows(std::ssize(blocks), 1, [&](int64_t b) {
    int64_t u = blocks[b].visible_before, index = blocks[b].splats_before;
    int32_t previous = -1;
    for (const KeptSplat<T>& kept : blocks[b].splats) {
      if (kept.id != previous) {
        ids.visible_ids[u] = previous = kept.id;
        ids.splat_offsets[u++] = int32_t(index);
      }
      ids.gaussian_ids[index] = kept.id;
      ids.camera_ids[index] = kept.view;
      write_splat(in, cameras[kept.view], index++, kept, columns.values);
    }
  });
}

template <class T>
void color_splats(const ProjectInputs<T>& in, const ProjectCapacity& capacity,
                  const ProjectColumns<T>& columns, CudaStream) {
  const std::vector<Camera<T>> cameras = make_cameras(in);
  const ProjectOutputs<T>& out = columns.values;
  parallel_rows(capacity.sizes.splats, 1 << 10, [&](int64_t i) {
    const int64_t id = columns.ids.gaussian_ids[i];
    if (splat_color(cameras[columns.ids.camera_ids[i]], load3(in.means + 3 * id),
                    in.sh + 3 * in.options.sh_stride * id, in.options.sh_degree, out.colors + 3 * i)) {
      return;
    }
    out.opacities[i] = T(0);
    out.radii[2 * i] = out.radii[2 * i + 1] = out.tiles_touched[i] = 0;
  });
}

template <class T>
void project_bwd(const ProjectInputs<T>& in, const SplatIndex& splats, const SplatGradientColumns<T>& v,
                 const Regularisers<T>& regularisers, const ProjectGradients<T>& out, Workspace&,
                 CudaStream) {
  const std::vector<Camera<T>> cameras = make_cameras(in);
  const int64_t blocks = project_blocks(splats.n_visible);
  std::vector<double> pose_sums(out.viewmats ? blocks * in.n_views * 12 : 0, 0.0);
  parallel_rows(blocks, 1, [&](int64_t block) {
    std::vector<PoseGradient<T>> poses(out.viewmats ? in.n_views : 0);
    const int64_t last = std::min(splats.n_visible, (block + 1) * kProjectBlock);
    for (int64_t u = block * kProjectBlock; u < last; ++u) {
      gaussian_bwd(in, cameras, splats, v, regularisers, u, poses.empty() ? nullptr : poses.data(), out);
    }
    if (out.viewmats) store_poses(poses, &pose_sums[block * in.n_views * 12]);
  });
  if (out.viewmats) reduce_poses(pose_sums.data(), blocks, in.n_views, out.viewmats);
}

template <class T> void zero_arrays(const ZeroedArrays<T>& arrays, CudaStream) {
  for (int a = 0; a < ZeroedArrays<T>::kCount; ++a) parallel_zero(arrays.begin[a], arrays.length[a]);
}

template <class T>
void project_bwd_step(const ProjectInputs<T>& in, const SplatIndex& splats, const SplatGradientColumns<T>& v,
                      const Regularisers<T>& regularisers, AdamArgs<T> adam, Workspace& workspace,
                      CudaStream stream) {
  const ProjectGradients<T> gradients = scratch_gradients(splats, adam, workspace);
  project_bwd(in, splats, v, regularisers, gradients, workspace, stream);
  lazy_adam(adam, workspace, stream);
}

BLITZGS_FOR_BOTH_DTYPES(project);
BLITZGS_FOR_BOTH_DTYPES(color_splats);
BLITZGS_FOR_BOTH_DTYPES(project_bwd);
BLITZGS_FOR_BOTH_DTYPES(zero_arrays);
BLITZGS_FOR_BOTH_DTYPES(project_bwd_step);

}  // namespace blitzgs::cpu
