// SPDX-License-Identifier: Apache-2.0
#include <tuple>

#include "project/project_forward_op.h"

namespace blitzgs {
namespace {

// The one allocation of project_count that outlives it.
class Carry final : public Workspace {
 public:
  explicit Carry(const Tensor& like) : like_(like), tensor_(make_empty(like, {0}, ScalarType::Byte)) {}
  void* allocate_bytes(std::size_t bytes) override {
    tensor_ = make_empty(like_, {static_cast<std::int64_t>(bytes)}, ScalarType::Byte);
    return tensor_.mutable_data_ptr();
  }
  const Tensor& tensor() const { return tensor_; }

 private:
  Tensor like_, tensor_;
};

// Counts the rows and, on CUDA, writes as many as there is room for, without colours.
std::tuple<Tensor, Tensor, Tensor, RowList> project_count(
    const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
    const OptionalTensor& sh, const Tensor& viewmats, const Tensor& Ks, const OptionalTensor& active_ids,
    const OptionalTensor& active_views, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t sh_degree, double near_plane, double far_plane, double eps2d, double radius_clip,
    bool antialiased, bool raw, const std::vector<std::int64_t>& tile_begins,
    const std::vector<std::int64_t>& tile_ends, const OptionalTensor& active_count,
    [[maybe_unused]] std::int64_t visible_room, [[maybe_unused]] std::int64_t row_room,
    const OptionalTensor& ids) {
  constexpr const char* kOp = "project_count";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width,
                  height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
                  tile_begins, tile_ends, active_count);
  const OptionalTensor persistent = checked_ids(kOp, f, ids);
  const std::size_t bytes = backend::project_plan_bytes(f.candidates);
  Tensor plan = make_empty(f.p.means, {static_cast<std::int64_t>((bytes + 7) / 8)}, ScalarType::Long);
  Tensor totals = make_empty(f.p.means, {project_totals(f.p.n_views, f.ranks.n_ranks)}, ScalarType::Long);
  Carry carry(f.p.means);
  RowList rows;
  DeviceScope scope(f.p.means);
#ifdef BLITZGS_BACKEND_CUDA
  const auto in = f.inputs<float>();
  const ProjectSizes room{visible_room, row_room};
  if (visible_room > 0 && row_room > 0) rows = make_rows(f, room, persistent.has_value());
  cuda::project_survey(in, plan.mutable_data_ptr(), scope.workspace, scope.stream);
  cuda::project_rows(in, f.ranks, plan.const_data_ptr(), room_of(rows),
                     rows.empty() ? ProjectIds{} : row_ids(rows),
                     rows.empty() ? ProjectOutputs<float>{} : row_values<float>(f, rows, persistent),
                     mutable_data<std::int64_t>(totals), scope.workspace, scope.stream);
#else
  dispatch_floating(f.p.means, [&](auto zero) {
    cpu::project_count(f.inputs<decltype(zero)>(), f.ranks, plan.mutable_data_ptr(), carry,
                       mutable_data<std::int64_t>(totals), scope.workspace, scope.stream);
  });
#endif
  return {plan, carry.tensor(), totals, rows};
}

ProjectSizes told_sizes(const char* op, const Tensor& counts) {
  check_dtype(op, "counts", counts, ScalarType::Long);
  STD_TORCH_CHECK(counts.is_cpu() && counts.numel() >= 2, "blitzgs::", op,
                  ": counts must be the totals of project_count, on the CPU");
  const auto* numbers = data<std::int64_t>(counts);
  return {numbers[kTotalVisible], numbers[kTotalRows]};
}

using RowTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                              Tensor, Tensor, Tensor>;

// Writes all rows of a plan.
RowTensors project_emit(const Tensor& means, const Tensor& quats, const Tensor& scales,
                        const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats,
                        const Tensor& Ks, const OptionalTensor& active_ids,
                        const OptionalTensor& active_views, std::int64_t width, std::int64_t height,
                        std::int64_t tile_size, std::int64_t sh_degree, double near_plane, double far_plane,
                        double eps2d, double radius_clip, bool antialiased, bool raw,
                        const std::vector<std::int64_t>& tile_begins,
                        const std::vector<std::int64_t>& tile_ends, const OptionalTensor& active_count,
                        const Tensor& plan, [[maybe_unused]] const Tensor& carry, const Tensor& counts,
                        const OptionalTensor& ids) {
  constexpr const char* kOp = "project_emit";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width,
                  height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
                  tile_begins, tile_ends, active_count);
  check_plan(kOp, f, plan);
  const OptionalTensor persistent = checked_ids(kOp, f, ids);
  const ProjectSizes sizes = told_sizes(kOp, counts);
  STD_TORCH_CHECK(sizes.rows <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", kOp, ": ", sizes.rows,
                  " rows (Gaussians seen, summed over views) exceed 2^31 - 1; project fewer views at a time");
  RowList r = make_rows(f, sizes, persistent.has_value());
  DeviceScope scope(f.p.means);
  dispatch_floating(f.p.means, [&](auto zero) {
    using T = decltype(zero);
    const ProjectInputs<T> in = f.inputs<T>();
    const ProjectIds listed = row_ids(r);
    const ProjectOutputs<T> values = row_values<T>(f, r, persistent);
    const ProjectRoom room{sizes, nullptr};
#ifdef BLITZGS_BACKEND_CUDA
    cuda::project_rows(in, f.ranks, plan.const_data_ptr(), sizes, listed, values, nullptr, scope.workspace,
                       scope.stream);
    cuda::project_colors(in, listed, room, values, scope.stream);
#else
    cpu::project_list(in, plan.const_data_ptr(), room, listed, scope.workspace, scope.stream);
    cpu::project_emit(in, f.ranks, carry.const_data_ptr(), listed, room, values, scope.workspace,
                      scope.stream);
#endif
  });
  return {r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11], r[12]};
}

#ifdef BLITZGS_BACKEND_CUDA
// Gives the rows of project_count their colours, as far as there was room for them.
void project_colors(const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
                    const OptionalTensor& sh, const Tensor& viewmats, const Tensor& Ks, std::int64_t width,
                    std::int64_t height, std::int64_t sh_degree, const Tensor& totals, RowList rows) {
  constexpr const char* kOp = "project_colors_";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, std::nullopt, std::nullopt, width,
                  height, 16, sh_degree, 0, 0, 0, 0, false, false, {}, {}, std::nullopt);
  check_rows(kOp, f, rows);
  if (rows.empty()) return;
  check_dtype(kOp, "totals", totals, ScalarType::Long);
  STD_TORCH_CHECK(totals.is_contiguous() && totals.device() == f.p.means.device() &&
                      totals.numel() >= project_totals(f.p.n_views, 0),
                  "blitzgs::", kOp, ": totals must be those of project_count");
  DeviceScope scope(f.p.means);
  cuda::project_colors(f.inputs<float>(), row_ids(rows), {room_of(rows), data<std::int64_t>(totals)},
                       row_values<float>(f, rows, std::nullopt), scope.stream);
}
#endif

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("project_count", TORCH_BOX(&blitzgs::project_count));
  m.impl("project_emit", TORCH_BOX(&blitzgs::project_emit));
#ifdef BLITZGS_BACKEND_CUDA
  m.impl("project_colors_", TORCH_BOX(&blitzgs::project_colors));
#endif
}
