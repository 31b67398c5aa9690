// SPDX-License-Identifier: Apache-2.0
// Every op of BlitzGS, one readable list. N Gaussians, B views, P projected rows (a Gaussian in a view), U
// Gaussians visible in at least one view, I row-tile intersections, D channels, K = (degree + 1)^2 SH
// coefficients. An argument n_rows, int64 [1]: only the first of the P rows are there. Contracts:
// csrc/<op>/<op>.h; Python functions, fake kernels and autograd: blitzgs/ops/<op>.py.
#include <torch/csrc/stable/library.h>

STABLE_TORCH_LIBRARY(blitzgs, m) {
  // The active set: blocks of consecutive rows with bounds, culled against the views.
  m.def("morton_keys(Tensor points) -> Tensor");
  m.def(
      "update_block_bounds_(Tensor(a!) bounds, Tensor? ids, Tensor means, Tensor scales, Tensor[] moments, "
      "Tensor? last_step, Tensor? moment_step, Tensor? table) -> ()");
  m.def(
      "cull_blocks(Tensor bounds, Tensor means, Tensor scales, Tensor[] moments, Tensor? last_step, "
      "Tensor? moment_step, Tensor? table, Tensor viewmats, Tensor Ks, int width, int height, "
      "float near_plane, float far_plane, float eps2d) -> (Tensor active_ids, Tensor active_views, "
      "Tensor count)");

  // Projection: parameters to screen-space rows, ordered by (Gaussian, view).
  m.def(
      "project_count(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor? sh, "
      "Tensor viewmats, Tensor Ks, Tensor? active_ids, Tensor? active_views, int width, int height, "
      "int tile_size, int sh_degree, float near_plane, float far_plane, float eps2d, float radius_clip, "
      "bool antialiased, bool raw, int[] tile_begins, int[] tile_ends, Tensor? active_count=None, "
      "int visible_room=0, int row_room=0, Tensor? ids=None) -> (Tensor plan, Tensor carry, Tensor totals, "
      "Tensor[] rows)");
  m.def(
      "project_emit(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor? sh, "
      "Tensor viewmats, Tensor Ks, Tensor? active_ids, Tensor? active_views, int width, int height, "
      "int tile_size, int sh_degree, float near_plane, float far_plane, float eps2d, float radius_clip, "
      "bool antialiased, bool raw, int[] tile_begins, int[] tile_ends, Tensor? active_count, Tensor plan, "
      "Tensor carry, Tensor counts, Tensor? ids=None) -> (Tensor gaussian_ids, "
      "Tensor camera_ids, Tensor visible_ids, Tensor row_offsets, "
      "Tensor means2d, Tensor conics, Tensor depths, Tensor row_opacities, Tensor colors, Tensor radii, "
      "Tensor tiles_touched, Tensor rank_masks, Tensor row_ids)");
  // The colours of the rows that project_count had room for.
  m.def(
      "project_colors_(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor? sh, "
      "Tensor viewmats, Tensor Ks, int width, int height, int sh_degree, Tensor totals, "
      "Tensor(a!)[] rows) -> ()");
  // Colours, unless colors_stream is 0, in that stream: they are valid, here and there, once it was waited
  // for.
  m.def(
      "project_rows_to_peers_(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor? sh, "
      "Tensor viewmats, Tensor Ks, int width, int height, int sh_degree, Tensor everyone, int rank, "
      "Tensor(a!)[] rows, Tensor(b!)[] buffers, int capacity, int colors_stream) -> "
      "Tensor[]");
  m.def(
      "project_bwd(Tensor means, Tensor quats, Tensor scales, Tensor opacities, Tensor? sh, Tensor viewmats, "
      "Tensor Ks, Tensor camera_ids, Tensor visible_ids, Tensor row_offsets, int width, int height, "
      "int sh_degree, float eps2d, bool antialiased, bool raw, Tensor? v_means2d, Tensor? v_conics, "
      "Tensor? v_depths, Tensor? v_row_opacities, Tensor? v_colors, Tensor? scale_reg, bool need_viewmats, "
      "Tensor? places=None, int[] group_sizes=[], int[] starts=[], Tensor[]? buffers=None, int offset=0, "
      "bool dense=False) -> ("
      "Tensor v_means, Tensor v_quats, "
      "Tensor v_scales, Tensor v_opacities, Tensor v_sh, Tensor v_viewmats)");
  // project_bwd, then lazy_adam_step_ of the visible rows.
  m.def(
      "project_bwd_step_(Tensor(a!)[] params, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs, "
      "Tensor(d!) last_step, Tensor(e!) moment_step, Tensor table, Tensor lr_table, int step, "
      "int explicit_steps, float beta1, float beta2, float eps, bool sparse, Tensor viewmats, Tensor Ks, "
      "Tensor camera_ids, Tensor visible_ids, Tensor row_offsets, int width, int height, int sh_degree, "
      "float eps2d, bool antialiased, Tensor? v_means2d, Tensor? v_conics, Tensor? v_row_opacities, "
      "Tensor? v_colors, Tensor? scale_reg, Tensor? places=None, int[] group_sizes=[], int[] starts=[], "
      "Tensor[]? buffers=None, int offset=0, Tensor(f!)? means2d_sums=None) -> ()");

  // Which rows each tile composites, front to back by (depth, id).
  m.def(
      "intersect(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor depths, Tensor camera_ids, "
      "Tensor? ids, int n_cameras, int width, int height, int tile_size, int tile_begin, int tile_end, "
      "int n_isects, Tensor? n_rows=None) -> (Tensor isect_rows, Tensor tile_offsets)");

  // Which ranks a row has to be sent to.
  m.def(
      "route_count(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor camera_ids, int[] "
      "tile_begins, int[] tile_ends, int width, int height, int tile_size) -> (Tensor masks, Tensor counts)");

  // Rows on their way between ranks, packed for a collective or written straight into peers' memory (CUDA).
  m.def("scatter_rows(Tensor[] columns, Tensor masks, int[] group_sizes) -> (Tensor packed, Tensor places)");
  m.def("gather_rows(Tensor packed, int[] widths, int[] group_sizes) -> Tensor[] columns");
  m.def(
      "sum_rows(Tensor values, Tensor places, int[] group_sizes, int rows, int[] widths) -> "
      "Tensor[] columns");
  m.def(
      "meet_peers_(Tensor(a!)[] mail, int rank, int meeting, Tensor? values, int first, "
      "float timeout_seconds, Tensor(b!)? known=None) -> ()");
  // Writes a small tensor into pinned memory of the host, behind what is queued (CUDA).
  m.def("tell_host_(Tensor(a!) known, Tensor values) -> ()");

  // Alpha compositing.
  m.def(
      "rasterize_fwd(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor colors, Tensor? "
      "backgrounds, "
      "Tensor isect_rows, Tensor tile_offsets, int n_cameras, int width, int height, int tile_size, "
      "int tile_begin, int tile_end, Tensor? means2d_abs=None, bool clear_rest=True, "
      "bool backward_follows=False, Tensor? n_rows=None) -> (Tensor renders, Tensor transmittances, "
      "Tensor last_ids, Tensor tile_work, Tensor aux, Tensor row_gradients)");
  // The same for a backward pass that adds up gradients in `packed`, which is zeroed; pixels that nobody owns
  // are left as they are (CUDA).
  m.def(
      "rasterize_fwd_packed_(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor colors, Tensor? "
      "backgrounds, Tensor isect_rows, Tensor tile_offsets, int n_cameras, int width, int height, "
      "int tile_size, int tile_begin, int tile_end, Tensor(a!) packed, Tensor? n_rows=None) -> ("
      "Tensor renders, Tensor transmittances, Tensor last_ids, Tensor tile_work, Tensor aux)");
  m.def(
      "rasterize_bwd(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor colors, Tensor? "
      "backgrounds, "
      "Tensor isect_rows, Tensor tile_offsets, Tensor renders, Tensor transmittances, Tensor last_ids, "
      "Tensor aux, Tensor v_renders, Tensor? v_alphas, int n_cameras, int width, int height, int tile_size, "
      "int tile_begin, int tile_end, bool absgrad, bool deterministic) -> (Tensor v_means2d, Tensor "
      "v_conics, "
      "Tensor v_row_opacities, Tensor v_colors, Tensor v_means2d_abs)");
  m.def(
      "rasterize_bwd_packed_(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor colors, Tensor? "
      "backgrounds, Tensor isect_rows, Tensor tile_offsets, Tensor renders, Tensor transmittances, Tensor "
      "last_ids, Tensor aux, Tensor v_renders, int n_cameras, int width, int height, int tile_size, "
      "int tile_begin, int tile_end, bool deterministic, Tensor(a!) packed) -> ()");

  // What each row contributes to the pixels, without colours.
  m.def(
      "contributions(Tensor means2d, Tensor conics, Tensor row_opacities, Tensor isect_rows, "
      "Tensor tile_offsets, int n_cameras, int width, int height, int tile_size, int tile_begin, "
      "int tile_end, Tensor? n_rows=None) -> (Tensor weights, Tensor pixels)");

  // L1 and SSIM of the owned tiles; fwd_bwd does both at once when the weights of the sums are known.
  m.def(
      "photometric_fwd(Tensor renders, Tensor targets, Tensor? masks, int tile_size, int tile_begin, "
      "int tile_end) -> (Tensor l1_sums, Tensor ssim_sums)");
  m.def(
      "photometric_bwd(Tensor renders, Tensor targets, Tensor? masks, Tensor l1_weights, Tensor "
      "ssim_weights, "
      "int tile_size, int tile_begin, int tile_end) -> Tensor v_renders");
  m.def(
      "photometric_fwd_bwd(Tensor renders, Tensor targets, Tensor? masks, Tensor l1_weights, "
      "Tensor ssim_weights, int tile_size, int tile_begin, int tile_end, Tensor? samples=None, "
      "Tensor? visible=None, float scale_weight=0.0) -> (Tensor parts, Tensor v_renders, Tensor scale_reg)");
  m.def(
      "report_(Tensor? parts, Tensor? tile_work, int tile_begin, int tile_end, int rank, int n_ranks, "
      "Tensor(a!)[] targets) -> ()");

  // The optimiser: dense Adam over an index list, and its statistics for density control.
  m.def(
      "lazy_adam_step_(Tensor(a!)[] params, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs, Tensor[] grads, "
      "Tensor ids, Tensor(d!) last_step, Tensor(e!) moment_step, Tensor table, Tensor lr_table, int step, "
      "int explicit_steps, float beta1, float beta2, float eps, bool sparse) -> ()");
  m.def(
      "lazy_adam_catch_up_(Tensor(a!)[] params, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs, Tensor? "
      "ids, "
      "Tensor(d!) last_step, Tensor(e!) moment_step, Tensor table, Tensor lr_table, int step, "
      "int explicit_steps, float beta1, "
      "float beta2, float eps, Tensor? count=None) -> ()");
  m.def(
      "density_stats_(Tensor(a!) grad_sum, Tensor(b!) grad_count, Tensor(c!) max_radii, Tensor visible_ids, "
      "Tensor row_offsets, Tensor v_means2d, Tensor conics, Tensor? phi, int width, int height, float "
      "weight) -> ()");

  // Rows of a table, old and new, in another order.
  m.def("take_rows(Tensor column, Tensor rows, Tensor? fresh) -> Tensor");

  // Scene initialisation.
  m.def("voxel_keys(Tensor points, float[] origin, float voxel_size) -> Tensor");
  m.def("knn_distances(Tensor points, int k) -> Tensor");
}
