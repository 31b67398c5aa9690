// SPDX-License-Identifier: Apache-2.0
// Colours, tile lists, compositing and alphas in one op, because each call of an op takes the host
// microseconds.
#include "render/render.h"

#include <optional>
#include <tuple>
#include <vector>

#include "project/color_rows.h"
#include "project/project_op.h"
#include "render/gather_rows_op.h"

namespace blitzgs {

// Defined in intersect_op.cpp and rasterize_op.cpp.
std::tuple<Tensor, Tensor> intersect(const Tensor& means2d, const Tensor& conics,
                                     const Tensor& splat_opacities, const Tensor& depths,
                                     const Tensor& camera_ids, const std::optional<Tensor>& ids,
                                     std::int64_t n_cameras, std::int64_t width, std::int64_t height,
                                     std::int64_t tile_size, std::int64_t tile_begin, std::int64_t tile_end,
                                     std::int64_t n_isects, const std::optional<Tensor>& known_splats,
                                     bool unchecked);
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_splats, const Tensor& tile_offsets,
    std::int64_t n_cameras, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t tile_begin, std::int64_t tile_end, bool clear_rest, bool backward_follows,
    const std::optional<Tensor>& known_splats);

namespace {

constexpr const char* kOp = "render";

// The totals of the projection; null: the splats have no spare capacity.
const std::int64_t* checked_totals(const OptionalTensor& totals) {
  if (!totals) return nullptr;
  check_in_place(kOp, "totals", *totals, ScalarType::Long, {-1});
  STD_TORCH_CHECK(totals->size(0) > kTotalSplats, "blitzgs::", kOp,
                  ": totals must be those of project_fwd, got ", shape_of(*totals));
#ifndef BLITZGS_BACKEND_CUDA
  STD_TORCH_CHECK(false, "blitzgs::", kOp, ": on the CPU splats have no spare capacity, so give no totals");
#endif
  return data<std::int64_t>(*totals);
}

// The columns of splats that their colours are computed from, and those that hide a splat.
struct ColoredSplats {
  const Tensor &visible_ids, &splat_offsets, &camera_ids;
  Tensor &opacities, &radii, &tiles_touched;
};

// The visible rows of the Gaussians and the colours of their splats: colors, numbers, indices, rows.
TensorList color_rows(const TensorList& gaussians, const TensorList& sh, const Tensor& viewmats,
                      const Tensor& Ks, const ProjectOptions<double>& options, const ColoredSplats& splats,
                      const std::int64_t* totals) {
  check_group(kOp, "gaussians (means, quats, scales, opacities)", gaussians, 4, 4);
  check_floating(kOp, "means", gaussians[0]);
  const std::int64_t U = splats.visible_ids.numel(), P = splats.camera_ids.numel();
  check_in_place(kOp, "visible_ids", splats.visible_ids, ScalarType::Int, {U});
  check_in_place(kOp, "splat_offsets", splats.splat_offsets, ScalarType::Int, {U + 1});
  check_in_place(kOp, "camera_ids", splats.camera_ids, ScalarType::Int, {P});
  check_in_place(kOp, "splat_opacities", splats.opacities, gaussians[0].scalar_type(), {P});
  check_in_place(kOp, "radii", splats.radii, ScalarType::Int, {P, 2});
  check_in_place(kOp, "tiles_touched", splats.tiles_touched, ScalarType::Int, {P});
  const ProjectCapacity capacity{{U, P}, totals};
  TensorList found =
      gathered_rows(kOp, gaussians, sh, splats.visible_ids, totals ? totals + kTotalVisible : nullptr);
  const ProjectArguments p(kOp, found, viewmats, Ks, options);
  Tensor numbers = make_empty(splats.visible_ids, {U}),
         indices = make_empty(splats.visible_ids, {U}, ScalarType::Long);
  Tensor colors = make_empty(p.means, {p.sh ? P : 0, 3});
  DeviceScope scope(p.means);
  auto* row_of_splat = scope.workspace.allocate<std::int32_t>(P);
  backend::number_rows(
      {data<std::int32_t>(splats.visible_ids), data<std::int32_t>(splats.splat_offsets),
       mutable_data<std::int32_t>(numbers), mutable_data<std::int64_t>(indices), row_of_splat},
      capacity, scope.stream);
  if (p.sh) {
    dispatch_floating(p.means, [&](auto zero) {
      using T = decltype(zero);
      ProjectColumns<T> columns{};
      columns.ids.gaussian_ids = row_of_splat;
      // The kernels of project_fwd write the ids; those of this op only read them.
      columns.ids.camera_ids = const_cast<std::int32_t*>(data<std::int32_t>(splats.camera_ids));
      columns.values.colors = mutable_data<T>(colors);
      columns.values.opacities = mutable_data<T>(splats.opacities);
      columns.values.radii = mutable_data<std::int32_t>(splats.radii);
      columns.values.tiles_touched = mutable_data<std::int32_t>(splats.tiles_touched);
      backend::color_splats(p.inputs<T>(), capacity, columns, scope.workspace, scope.stream);
    });
  }
  found.insert(found.begin(), {colors, numbers, indices});
  return found;
}

// The columns side by side, by torch.
Tensor joined(const Tensor& colors, const Tensor& depths) {
  std::array<StableIValue, 2> stack{
      torch::stable::detail::from(TensorList{colors, torch::stable::unsqueeze(depths, 1)}),
      torch::stable::detail::from(std::int64_t{1})};
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher("aten::cat", "", stack.data(), TORCH_ABI_VERSION));
  return torch::stable::detail::to<Tensor>(stack[0]);
}

TensorList render(const Tensor& means2d, const Tensor& conics, Tensor splat_opacities, const Tensor& depths,
                  const Tensor& camera_ids, const Tensor& visible_ids, const Tensor& splat_offsets,
                  Tensor radii, Tensor tiles_touched, const OptionalTensor& channels_in, bool with_depth,
                  const TensorList& gaussians, const TensorList& sh, const Tensor& viewmats, const Tensor& Ks,
                  std::int64_t width, std::int64_t height, std::int64_t tile_size, std::int64_t sh_degree,
                  double near_plane, double far_plane, double eps2d, double radius_clip, bool antialiased,
                  bool raw, const FloatList& fade, const OptionalTensor& backgrounds, std::int64_t n_isects,
                  bool backward_follows, const OptionalTensor& totals_in) {
  const std::int64_t* totals = checked_totals(totals_in);
  OptionalTensor n_splats;
  if (totals) n_splats = view_of(*totals_in, {1}, {1}, kTotalSplats);
  TensorList rows;
  if (!gaussians.empty()) {
    const auto options = checked_options(kOp, width, height, tile_size, sh_degree, near_plane, far_plane,
                                         eps2d, radius_clip, antialiased, raw, fade);
    rows =
        color_rows(gaussians, sh, viewmats, Ks, options,
                   {visible_ids, splat_offsets, camera_ids, splat_opacities, radii, tiles_touched}, totals);
  }
  STD_TORCH_CHECK(channels_in || !sh.empty(), "blitzgs::", kOp, ": splats without sh need channels");
  const Tensor channels = channels_in ? *channels_in : with_depth ? joined(rows[0], depths) : rows[0];
  const std::int64_t views = viewmats.size(0);
  const auto lists = intersect(means2d, conics, splat_opacities, depths, camera_ids, std::nullopt, views,
                               width, height, tile_size, 0, -1, n_isects, n_splats, /*unchecked=*/true);
  const auto outputs = rasterize_fwd(means2d, conics, splat_opacities, channels, backgrounds,
                                     std::get<0>(lists), std::get<1>(lists), views, width, height, tile_size,
                                     0, -1, /*clear_rest=*/true, backward_follows, n_splats);
  const Tensor& transmittances = std::get<1>(outputs);
  Tensor alphas = make_empty(transmittances, {views, height, width});
  DeviceScope scope(alphas);
  dispatch_floating(alphas, [&](auto zero) {
    using T = decltype(zero);
    backend::alphas_of(data<T>(transmittances), alphas.numel(), mutable_data<T>(alphas), scope.stream);
  });
  TensorList found = std::apply([&](const auto&... tensors) { return TensorList{tensors..., alphas}; },
                                std::tuple_cat(lists, outputs));
  found.insert(found.end(), rows.begin(), rows.end());
  return found;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("render", TORCH_BOX(&blitzgs::render)); }
