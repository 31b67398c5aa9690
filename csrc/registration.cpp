// SPDX-License-Identifier: Apache-2.0
// The signatures of all ops of BlitzGS. Letters: N Gaussians, B views, P projected splats (pairs of a
// Gaussian and a view), U Gaussians visible in at least one view, I splat-tile intersections, D channels,
// K = (degree + 1)^2 SH coefficients. An argument n_splats, int64 [1], says how many of the P splats are
// valid. A SymInt is a number that `torch.compile` may leave open, so that one graph takes any image size and
// number of views. A header of csrc/ defines what an op computes; blitzgs/ops/ has its Python function and
// autograd, and blitzgs/_fakes.py its fake kernel.
#include <torch/csrc/stable/library.h>

#include <vector>

#include "common/kernel.h"

namespace blitzgs {
namespace {

std::vector<int64_t> splat_gradient_layout() {
  constexpr int64_t kFloat = sizeof(float);
  return {offsetof(SplatGradient, mean2d) / kFloat,     offsetof(SplatGradient, conic) / kFloat,
          offsetof(SplatGradient, opacity) / kFloat,    offsetof(SplatGradient, color) / kFloat,
          offsetof(SplatGradient, mean2d_abs) / kFloat, kSplatGradient};
}

}  // namespace
}  // namespace blitzgs

STABLE_TORCH_LIBRARY(blitzgs, m) {
  // The active set: blocks of consecutive rows with bounds, culled against the views.
  m.def("morton_keys(Tensor points) -> Tensor");
  // rows: (means, scales[, four moments of these, last_step, moment_step, table]), blitzgs/ops/blocks.py.
  m.def("update_block_bounds_(Tensor(a!) bounds, Tensor? ids, Tensor[] rows) -> ()");
  m.def(
      "cull_blocks(Tensor bounds, Tensor[] rows, Tensor viewmats, Tensor Ks, int width, int height, float "
      "near_plane, float far_plane, float eps2d, Tensor? level_ranges=None, Tensor? level=None, float[] "
      "reach=[], int lod_views=0, Tensor? cull=None, int[] columns=[], int? capacity_blocks=None) -> "
      "(Tensor active_ids, Tensor active_views, Tensor count, Tensor n_blocks)");
  // Clears the bits of pairs of a row and a view that the LOD gate or the cull mask drops.
  m.def(
      "gate_views_(Tensor ids, Tensor(a!) views, Tensor? count, Tensor means, Tensor level, Tensor "
      "viewmats, float[] reach, int lod_views, Tensor? cull, int[] columns) -> ()");

  // Projection. gaussians: means, quats, scales, opacities[, sh]. The options, from width to fade, are those
  // of `blitzgs.ops.project.project`, fade with the octree levels of the Gaussians in `level`. active_ids:
  // the candidates, of which the first n_active [1] are valid, with active_views; absent: all. rank_tiles:
  // begin and end of each rank's tiles. Without capacities the op waits for the numbers.
  m.def(
      "project_fwd(Tensor[] gaussians, Tensor viewmats, Tensor Ks, Tensor? active_ids, Tensor? "
      "active_views, Tensor? n_active, Tensor? n_blocks, Tensor? ids, Tensor? level, SymInt width, SymInt "
      "height, int tile_size, int sh_degree, float near_plane, float far_plane, float eps2d, float "
      "radius_clip, bool antialiased, bool raw, float[] fade, int[] rank_tiles, int? visible_capacity, "
      "int? splat_capacity) -> (Tensor gaussian_ids, Tensor camera_ids, Tensor visible_ids, Tensor "
      "splat_offsets, Tensor means2d, Tensor conics, Tensor depths, Tensor splat_opacities, Tensor colors, "
      "Tensor radii, Tensor tiles_touched, Tensor rank_masks, Tensor splat_ids, Tensor totals)");
  // scale_reg, opacity_reg: for each view, weights of the Gaussians' smallest axes and opacities. v_splats:
  // (v_means2d, v_conics, v_opacities[, v_colors]) or, on CUDA, one table of splat gradients.
  m.def(
      "project_bwd(Tensor[] gaussians, Tensor viewmats, Tensor Ks, Tensor? scale_reg, Tensor? opacity_reg, "
      "Tensor camera_ids, Tensor visible_ids, Tensor splat_offsets, Tensor? level, SymInt width, SymInt "
      "height, int tile_size, int sh_degree, float near_plane, float far_plane, float eps2d, float "
      "radius_clip, bool antialiased, bool raw, float[] fade, Tensor[] v_splats, Tensor? v_depths, bool "
      "need_viewmats, bool dense=False) -> (Tensor v_means, Tensor v_quats, Tensor v_scales, Tensor "
      "v_opacities, Tensor v_sh, Tensor v_viewmats)");
  // project_bwd, then lazy_adam_step_ of the visible Gaussians. blitzgs/ops/lazy_adam.py has the groups of
  // the optimiser: state (params, exp_avgs, exp_avg_sqs, last_step, moment_step); tables (table, lr_table[,
  // final_rules]).
  m.def(
      "project_bwd_step_(Tensor(a!)[] state, Tensor[] tables, int step, int explicit_steps, float beta1, "
      "float beta2, float eps, Tensor viewmats, Tensor Ks, Tensor? scale_reg, Tensor? opacity_reg, Tensor "
      "camera_ids, Tensor visible_ids, Tensor splat_offsets, Tensor? level, int width, int height, int "
      "tile_size, int sh_degree, float near_plane, float far_plane, float eps2d, float radius_clip, bool "
      "antialiased, bool raw, float[] fade, Tensor[] v_splats) -> ()");
  // The unscented projection (csrc/project/unscented.h). lenses [B, 13]: k1 to k6, p1, p2, s1 to s4, the
  // largest angle of a fisheye; shutter: 0 to 4, with viewmats_rs unless 4 (global); transform: alpha, beta,
  // kappa, margin, all_valid. unscented_visible finds which Gaussians have splats in which views, [N, B];
  // splat_offsets [N + 1] counts them. v_splats: of means2d, conics, depths, splat_opacities[, colors].
  m.def(
      "unscented_visible(Tensor[] gaussians, Tensor viewmats, Tensor Ks, Tensor lenses, Tensor? "
      "viewmats_rs, bool fisheye, int shutter, float[] transform, int width, int height, int tile_size, "
      "int sh_degree, float near_plane, float far_plane, float eps2d, float radius_clip, bool antialiased, "
      "bool raw) -> Tensor");
  m.def(
      "unscented_fwd(Tensor[] gaussians, Tensor viewmats, Tensor Ks, Tensor lenses, Tensor? viewmats_rs, "
      "bool fisheye, int shutter, float[] transform, int width, int height, int tile_size, int sh_degree, "
      "float near_plane, float far_plane, float eps2d, float radius_clip, bool antialiased, bool raw, "
      "Tensor gaussian_ids, Tensor camera_ids, Tensor splat_offsets) -> (Tensor means2d, Tensor conics, "
      "Tensor depths, Tensor splat_opacities, Tensor colors, Tensor radii, Tensor tiles_touched)");
  m.def(
      "unscented_bwd(Tensor[] gaussians, Tensor viewmats, Tensor Ks, Tensor lenses, Tensor? viewmats_rs, "
      "bool fisheye, int shutter, float[] transform, int width, int height, int tile_size, int sh_degree, "
      "float near_plane, float far_plane, float eps2d, float radius_clip, bool antialiased, bool raw, "
      "Tensor camera_ids, Tensor splat_offsets, Tensor[] v_splats) -> (Tensor v_means, Tensor v_quats, "
      "Tensor v_scales, Tensor v_opacities, Tensor v_sh)");
  // The offsets of the members of SplatGradient (common/kernel.h) in its floats, then their number.
  m.def("splat_gradient_layout() -> int[]");

  // The splats that each tile of the range composites (tile_end -1: of all), front to back. unchecked: the
  // caller itself checks whether n_isects is too small, and CUDA does not wait for the number.
  m.def(
      "intersect(Tensor means2d, Tensor conics, Tensor splat_opacities, Tensor depths, Tensor camera_ids, "
      "Tensor? ids, SymInt n_cameras, SymInt width, SymInt height, int tile_size, int tile_begin, int "
      "tile_end, int n_isects, Tensor? n_splats=None, bool unchecked=False) -> (Tensor isect_splats, "
      "Tensor tile_offsets)");

  // The exchange of splats between ranks: packed for a collective, or written to the memory of peers (CUDA).
  m.def(
      "scatter_splats(Tensor[] columns, Tensor masks, int[] group_sizes) -> (Tensor packed, Tensor places)");
  m.def("gather_splats(Tensor packed, int[] widths, int[] group_sizes) -> Tensor[] columns");
  m.def("sum_splats(Tensor[] values, Tensor places, int splats, int[] widths) -> Tensor[] columns");
  m.def(
      "send_splats_(Tensor[] columns, Tensor rank_masks, Tensor everyone, int rank, Tensor(a!)[] buffers, "
      "int capacity) -> (Tensor places, Tensor plan)");
  m.def(
      "device_barrier_(Tensor(a!)[] control, int rank, int number, Tensor? values, int first, float "
      "timeout_seconds, Tensor(b!)? host=None) -> ()");
  // Writes a small tensor to pinned memory of the host, in stream order (CUDA).
  m.def("copy_to_host_(Tensor(a!) host, Tensor values) -> ()");

  // Splats in the arrangement of `meta`: places are (order), or (images, gaussians) where the last two
  // dimensions of `shape` are the views and the Gaussians. The last column has the values `under` where there
  // is no splat, and the others have zeros.
  m.def(
      "arrange_splats(Tensor[] columns, Tensor[] places, int[] shape, Tensor? under=None) -> Tensor[] "
      "arranged");
  m.def("splats_of_arranged(Tensor[] arranged, Tensor[] places, int[] shape) -> Tensor[] columns");

  // Alpha compositing. composited: (transmittances, last_ids, packed_splats, tile_order) of the forward pass.
  m.def(
      "rasterize_fwd(Tensor means2d, Tensor conics, Tensor splat_opacities, Tensor colors, Tensor? "
      "backgrounds, Tensor isect_splats, Tensor tile_offsets, SymInt n_cameras, SymInt width, SymInt "
      "height, int tile_size, int tile_begin, int tile_end, bool clear_rest=True, bool "
      "backward_follows=False, Tensor? n_splats=None) -> (Tensor renders, Tensor transmittances, Tensor "
      "last_ids, Tensor tile_work, Tensor packed_splats, Tensor tile_order, Tensor splat_gradients)");
  // rasterize_fwd that sets a given table of gradients to zero and leaves the pixels of unowned tiles (CUDA).
  // It is an op of its own, because torch registers gradients for ops without mutable arguments alone.
  m.def(
      "rasterize_fwd_(Tensor means2d, Tensor conics, Tensor splat_opacities, Tensor colors, Tensor? "
      "backgrounds, Tensor isect_splats, Tensor tile_offsets, int n_cameras, int width, int height, int "
      "tile_size, int tile_begin, int tile_end, Tensor(a!) gradients, Tensor? n_splats=None) -> (Tensor "
      "renders, Tensor transmittances, Tensor last_ids, Tensor tile_work, Tensor packed_splats, Tensor "
      "tile_order)");
  // splats: (means2d, conics, splat_opacities, colors); lists: (isect_splats, tile_offsets). With gradients
  // (CUDA), the gradients of the splats are added to this table, and the columns returned are empty.
  m.def(
      "rasterize_bwd(Tensor[] splats, Tensor? backgrounds, Tensor[] lists, Tensor[] composited, Tensor "
      "v_renders, Tensor? v_alphas, SymInt n_cameras, SymInt width, SymInt height, int tile_size, int "
      "tile_begin, int tile_end, bool absgrad, bool deterministic, Tensor(a!)? gradients=None) -> (Tensor "
      "v_means2d, Tensor v_conics, Tensor v_splat_opacities, Tensor v_colors, Tensor v_means2d_abs)");
  // What follows the projection of a call: colours of the splats from the visible rows of `gaussians` (means,
  // quats, scales, opacities), whose SH are in parts in `sh`; lists; and compositing of `channels` or,
  // without, of the colours and, with_depth, the depths. Splats whose colour is not finite are hidden:
  // opacities, radii and tiles_touched become 0. totals: those of the projection, if the splats have spare
  // capacity. Returns isect_splats, tile_offsets, the outputs of rasterize_fwd, alphas, and with gaussians:
  // colors, the numbers of the rows, visible_ids as int64, and the rows of gaussians and joined sh.
  m.def(
      "render(Tensor means2d, Tensor conics, Tensor(a!) splat_opacities, Tensor depths, Tensor camera_ids, "
      "Tensor visible_ids, Tensor splat_offsets, Tensor(b!) radii, Tensor(c!) tiles_touched, Tensor? "
      "channels, bool with_depth, Tensor[] gaussians, Tensor[] sh, Tensor viewmats, Tensor Ks, int width, "
      "int height, int tile_size, int sh_degree, float near_plane, float far_plane, float eps2d, float "
      "radius_clip, bool antialiased, bool raw, float[] fade, Tensor? backgrounds, int n_isects, bool "
      "backward_follows, Tensor? totals) -> Tensor[] outputs");

  // The contributions of the splats to the image, without colours: the sums of their weights alpha T, their
  // pixels and, if asked for, the sums of the squares of the weights (otherwise [0]).
  m.def(
      "contributions(Tensor means2d, Tensor conics, Tensor splat_opacities, Tensor isect_splats, Tensor "
      "tile_offsets, int n_cameras, int width, int height, int tile_size, int tile_begin, int tile_end, "
      "Tensor? n_splats=None, bool squares=False) -> (Tensor weights, Tensor pixels, Tensor squares)");

  // For each pixel, or row that slots name: the final T, the number of splats, the one in the middle of the
  // light, and the strongest.
  m.def(
      "pixel_splats(Tensor means2d, Tensor conics, Tensor splat_opacities, Tensor isect_splats, Tensor "
      "tile_offsets, Tensor? slots, int n_rows, int n_cameras, int width, int height, int tile_size, int "
      "strongest) -> (Tensor transmittances, Tensor counts, Tensor medians, Tensor ids, Tensor weights)");

  // For each segment, the fewest items that hold a share of its weight. Runs the steps `first_step` to
  // `last_step` - 1 of the search; between calls the sums may be added up over ranks.
  m.def(
      "mass_cut_(Tensor weights, Tensor segments, Tensor owners, Tensor ids, Tensor(a!) searches, "
      "Tensor(b!) sums, Tensor(c!) listed, Tensor(d!) chosen, int numerator, int denominator, int "
      "first_step, int last_step) -> ()");
  // The sums of the importance sweep over a batch of views.
  m.def(
      "view_sums_(Tensor(a!)[] sums, Tensor[] splats, Tensor weights, Tensor pixels, Tensor counts, int[] "
      "columns, int rule, float eps, float unit) -> ()");

  // L1 and SSIM of the owned tiles; fwd_bwd computes sums and gradient in one pass.
  m.def(
      "photometric_fwd(Tensor renders, Tensor targets, Tensor? masks, int tile_size, int tile_begin, int "
      "tile_end) -> (Tensor l1_sums, Tensor ssim_sums)");
  m.def(
      "photometric_bwd(Tensor renders, Tensor targets, Tensor? masks, Tensor l1_weights, Tensor "
      "ssim_weights, int tile_size, int tile_begin, int tile_end) -> Tensor v_renders");
  m.def(
      "photometric_fwd_bwd(Tensor renders, Tensor targets, Tensor? masks, Tensor l1_weights, Tensor "
      "ssim_weights, int tile_size, int tile_begin, int tile_end, Tensor? samples=None, Tensor? "
      "visible=None, float scale_weight=0.0, float opacity_weight=0.0) -> (Tensor parts, Tensor v_renders, "
      "Tensor scale_reg, Tensor opacity_reg)");
  m.def(
      "report_(Tensor? parts, Tensor? tile_work, int tile_begin, int tile_end, int rank, int n_ranks, "
      "Tensor(a!)[] targets) -> ()");
  // The costs of tiles as they are stored for each view, and the division that follows from them (CPU).
  m.def("tile_costs(Tensor sums, int first, int views, int grain) -> Tensor[] costs");
  m.def(
      "divide_tiles(Tensor[] costs, Tensor[] similar, int tiles, int grain, float tile_cost, int parts) -> "
      "int[] bounds");
  // The loss of whole images, and its gradient. weights and samples: of each view, for the gradient; the loss
  // is l1_factor and ssim_factor times the sums over all views, plus offset.
  m.def(
      "l1_ssim_fwd_bwd(Tensor renders, Tensor targets, Tensor l1_weights, Tensor ssim_weights, Tensor "
      "samples, float l1_factor, float ssim_factor, float offset) -> (Tensor loss, Tensor v_renders)");

  // The optimiser, with the arguments of project_bwd_step_. ids: int32 [U] or int64 [U] or [1, U]. current:
  // the parameters of the listed rows (None: all) are at the step before. rates: of a single parameter, they
  // enter the tables (`RatesArgs`), and taken, float32 [] on the CPU, counts the step.
  m.def(
      "lazy_adam_step_(Tensor(a!)[] state, Tensor(b!)[] tables, int step, int explicit_steps, float beta1, "
      "float beta2, float eps, Tensor[] grads, Tensor? ids, bool current=False, float[] rates=[], "
      "Tensor(c!)? taken=None) -> ()");
  m.def(
      "lazy_adam_catch_up_(Tensor(a!)[] state, Tensor[] tables, int step, int explicit_steps, float beta1, "
      "float beta2, float eps, Tensor? ids, Tensor? count=None) -> ()");
  // The rules of the total drift of a row, by the step of its parameters; `like` has their dtype.
  m.def("lazy_adam_final_rules(Tensor table, Tensor like, int explicit_steps, float eps) -> Tensor");
  m.def(
      "density_stats_(Tensor(a!) grad_sum, Tensor(b!) grad_count, Tensor(c!) max_radii, Tensor "
      "visible_ids, Tensor splat_offsets, Tensor v_means2d, Tensor conics, Tensor? phi, int width, int "
      "height, float weight) -> ()");

  m.def(
      "position_noise_(Tensor(a!) means, Tensor quats, Tensor scales, Tensor opacities, Tensor ids, Tensor "
      "visible_ids, int seed, int step, float threshold, float strength) -> ()");
  m.def(
      "limit_scales_(Tensor(a!) scales, Tensor means, Tensor visible_ids, float share, float extent) -> ()");

  // Relocation (csrc/population/relocation.h). moments: Adam's first moments of all parameters, then the
  // second ones.
  m.def("draw_weights(Tensor opacities, Tensor causes) -> Tensor");
  m.def(
      "residual_draws(Tensor weights, Tensor ids, int draws, int total, int seed, int event) -> (Tensor "
      "whole, Tensor keys)");
  m.def("overlap(Tensor opacities, Tensor copies) -> Tensor");
  m.def(
      "share_rows_(Tensor(a!) opacities, Tensor(b!) scales, Tensor(c!)[] moments, Tensor rows, "
      "Tensor copies, float least) -> ()");

  // What the spawn gate knows of candidates. columns: (grad_sum, grad_count, opacities, scales, birth, level,
  // exp_avg_sq.sh).
  m.def(
      "spawn_features(Tensor[] columns, Tensor rows, Tensor is_split, int time, float extent, int "
      "level_count) -> Tensor");
  // Gradient-boosted trees: the sum of the leaves that each row of features reaches.
  m.def("tree_sums(Tensor features, Tensor roots, Tensor nodes, Tensor leaves, int depth) -> Tensor");

  // Conversions of the cull mask between its layouts by row [N, words] and by sector [blocks, 32 words, 8].
  m.def("sectors_of_rows(Tensor rows) -> Tensor");
  m.def("rows_of_sectors(Tensor sectors, int n) -> Tensor");

  // Rows of columns in another order; and rows of columns overwritten by others, or (no `fresh`) by zeros.
  m.def("take_rows_(Tensor(a!)[] out, Tensor[] columns, Tensor rows) -> ()");
  m.def("put_rows_(Tensor(a!)[] columns, Tensor rows, Tensor[] fresh) -> ()");
  // Which new Gaussians take the rows of those that leave.
  m.def("bracket_keys(Tensor gone, Tensor blocks) -> Tensor");
  m.def(
      "match_brackets_(Tensor(a!) rows, Tensor(b!) is_left, Tensor keys, Tensor order, Tensor gone, Tensor "
      "by_block) -> ()");
  // The first rows of columns, in the same memory without autograd's knowledge.
  m.def("first_rows(Tensor[] columns, int[] lengths) -> Tensor[]");

  // For a table in the host's memory with a pool of blocks on the device (csrc/active/pool.h). The first
  // n_written columns are written back.
  m.def(
      "seen_blocks(Tensor bounds, Tensor viewmats, Tensor Ks, Tensor sizes, float near_plane, float "
      "far_plane, float eps2d) -> Tensor seen");
  m.def(
      "swap_blocks_(Tensor(a!)[] pool, Tensor(b!)[] table, int n_written, Tensor slots, Tensor leaving, "
      "Tensor coming) -> ()");

  // Hashes with one more key: a tensor, or a number where it is absent.
  m.def("hash_key(Tensor hashes, Tensor? keys, int number) -> Tensor");

  // Keys that sample without replacement, and the search for the k-th smallest (csrc/population/columns.h).
  m.def("sampling_keys(Tensor weights, Tensor ids, int seed, int event) -> Tensor");
  m.def("key_histogram(Tensor keys, Tensor prefix, int shift, int width) -> Tensor");
  m.def("find_digit_(Tensor(a!) search, Tensor counts) -> ()");
  m.def("keys_up_to(Tensor keys, Tensor limit) -> Tensor");

  // A number that is 0 if all values of the columns are finite and none of `nonzero` is 0.
  m.def("find_non_finite(Tensor[] columns, Tensor[] nonzero) -> Tensor");

  m.def("knn_distances(Tensor points, int k) -> Tensor");
}

STABLE_TORCH_LIBRARY_IMPL(blitzgs, CompositeExplicitAutograd, m) {
  m.impl("splat_gradient_layout", TORCH_BOX(&blitzgs::splat_gradient_layout));
}
