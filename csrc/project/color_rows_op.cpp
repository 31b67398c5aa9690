// SPDX-License-Identifier: Apache-2.0
#include "project/color_rows.h"

#include "project/project_op.h"
#include "render/gather_rows_op.h"

namespace blitzgs {
namespace {

constexpr const char* kOp = "color_rows_";

// Checks the totals of the projection, if the splats have spare capacity.
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

TensorList color_rows(const TensorList& tables, const TensorList& sh, const TensorList& cameras,
                      const TensorList& splats, TensorList shown, const IntList& ints,
                      const FloatList& floats, const OptionalTensor& totals) {
  check_group(kOp, "tables (means, quats, scales, opacities)", tables, 4, 4);
  check_group(kOp, "splats (visible_ids, splat_offsets, camera_ids)", splats, 3, 3);
  check_group(kOp, "shown (opacities, radii, tiles_touched)", shown, 3, 3);
  check_floating(kOp, "means", tables[0]);
  const Tensor &visible_ids = splats[0], &splat_offsets = splats[1], &camera_ids = splats[2];
  const std::int64_t U = visible_ids.numel(), P = camera_ids.numel();
  check_in_place(kOp, "visible_ids", visible_ids, ScalarType::Int, {U});
  check_in_place(kOp, "splat_offsets", splat_offsets, ScalarType::Int, {U + 1});
  check_in_place(kOp, "camera_ids", camera_ids, ScalarType::Int, {P});
  check_in_place(kOp, "opacities", shown[0], tables[0].scalar_type(), {P});
  check_in_place(kOp, "radii", shown[1], ScalarType::Int, {P, 2});
  check_in_place(kOp, "tiles_touched", shown[2], ScalarType::Int, {P});
  const ProjectCapacity capacity{{U, P}, checked_totals(totals)};
  TensorList found = gathered_rows(kOp, tables, sh, visible_ids,
                                   capacity.totals ? capacity.totals + kTotalVisible : nullptr);
  const ProjectArguments p(kOp, found, cameras, ints, floats, std::nullopt);
  Tensor numbers = make_empty(visible_ids, {U}), indices = make_empty(visible_ids, {U}, ScalarType::Long);
  Tensor colors = make_empty(p.means, {p.sh ? P : 0, 3});
  DeviceScope scope(p.means);
  auto* row_of_splat = scope.workspace.allocate<std::int32_t>(P);
  backend::number_rows(
      {data<std::int32_t>(visible_ids), data<std::int32_t>(splat_offsets),
       mutable_data<std::int32_t>(numbers), mutable_data<std::int64_t>(indices), row_of_splat},
      capacity, scope.stream);
  if (p.sh) {
    dispatch_floating(p.means, [&](auto zero) {
      using T = decltype(zero);
      ProjectColumns<T> columns{};
      columns.ids.gaussian_ids = row_of_splat;
      // The kernels of project_fwd write the ids; those of this op only read them.
      columns.ids.camera_ids = const_cast<std::int32_t*>(data<std::int32_t>(camera_ids));
      columns.values.colors = mutable_data<T>(colors);
      columns.values.opacities = mutable_data<T>(shown[0]);
      columns.values.radii = mutable_data<std::int32_t>(shown[1]);
      columns.values.tiles_touched = mutable_data<std::int32_t>(shown[2]);
      backend::color_splats(p.inputs<T>(), capacity, columns, scope.workspace, scope.stream);
    });
  }
  found.insert(found.begin(), {numbers, indices, colors});
  return found;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("color_rows_", TORCH_BOX(&blitzgs::color_rows)); }
