// SPDX-License-Identifier: Apache-2.0
// Rows to the ranks that composite them, through memory that these share.
#ifdef BLITZGS_BACKEND_CUDA
#include "common/stream_point.h"
#include "peers/peers_op.h"
#include "project/project_forward_op.h"

namespace blitzgs {
namespace {

// Sends the rows of project_count, which has to have had room for `capacity` of them, where they are
// composited. Returns places and what has to live until the colours are there.
std::vector<Tensor> project_rows_to_peers(const Tensor& means, const Tensor& quats, const Tensor& scales,
                                          const Tensor& opacities, const OptionalTensor& sh,
                                          const Tensor& viewmats, const Tensor& Ks, std::int64_t width,
                                          std::int64_t height, std::int64_t sh_degree, const Tensor& everyone,
                                          std::int64_t rank, RowList rows, std::vector<Tensor> buffers,
                                          std::int64_t capacity, std::int64_t colors_stream) {
  constexpr const char* kOp = "project_rows_to_peers_";
  const auto n_ranks = static_cast<std::int64_t>(buffers.size());
  const std::vector<std::int64_t> tiles(buffers.size());
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, std::nullopt, std::nullopt, width,
                  height, 16, sh_degree, 0, 0, 0, 0, false, false, tiles, tiles, std::nullopt);
  check_dtype(kOp, "means", f.p.means, ScalarType::Float);
  check_rows(kOp, f, rows);
  const ProjectSizes sizes = room_of(rows);
  STD_TORCH_CHECK(sizes.visible >= capacity && sizes.rows >= capacity && !rows.empty(), "blitzgs::", kOp,
                  ": rows must have room for ", capacity, " visible Gaussians and rows, got ", sizes.visible,
                  " and ", sizes.rows);
  const std::int64_t n_totals = project_totals(f.p.n_views, n_ranks);
  check_dtype(kOp, "everyone", everyone, ScalarType::Long);
  check_shape(kOp, "everyone", everyone, {n_ranks, n_totals});
  STD_TORCH_CHECK(everyone.is_contiguous() && !everyone.is_cpu() && rank >= 0 && rank < n_ranks,
                  "blitzgs::", kOp, ": everyone must be contiguous and on the GPU, and rank one of ", n_ranks,
                  ", got ", rank);
  const bool apart = colors_stream != 0;
  DeviceScope scope(f.p.means);
  Tensor places = make_places(f.p.means, capacity, n_ranks);
  Tensor admitted = make_empty(f.p.means, {(sizeof(ProjectAdmitted) + 7) / 8}, ScalarType::Long);
  const ProjectIds ids = row_ids(rows);
  ProjectOutputs<float> values = row_values<float>(f, rows, std::nullopt);
  values.row_ids = mutable_data<std::int64_t>(rows.back());
  const auto* shown = data<std::int64_t>(everyone);
  const ProjectRoom room{sizes, shown + rank * n_totals};
  const ProjectScatter scatter{
      reinterpret_cast<ProjectAdmitted*>(mutable_data<std::int64_t>(admitted)),
      places_of(places),
      shown,
      static_cast<int>(n_ranks),
      static_cast<int>(rank),
      capacity,
      peer_targets(kOp, buffers, kEmittedColumns, capacity, static_cast<int>(n_ranks)),
      !apart};
  const int n_views = static_cast<int>(f.p.n_views);
  if (!apart) {
    cuda::project_colors(f.inputs<float>(), ids, room, values, scope.stream);
    cuda::project_rows_to_ranks(ids, values, n_views, scatter, scope.stream);
    return {places, admitted};
  }
  const auto second = reinterpret_cast<CudaStream>(colors_stream);
  const cuda::StreamPoint met(scope.stream);
  cuda::project_rows_to_ranks(ids, values, n_views, scatter, scope.stream);
  const cuda::StreamPoint sent(scope.stream);
  met.hold(second);
  cuda::project_colors(f.inputs<float>(), ids, room, values, second, true);
  sent.hold(second);
  cuda::project_colors_to_ranks(values, scatter, second);
  // Contiguous copies end with this call: what takes their memory has to wait.
  const auto copied = [](const Tensor& given) { return !given.is_contiguous(); };
  if (copied(means) || (sh && copied(*sh)) || copied(viewmats) || copied(Ks)) {
    cuda::StreamPoint(second).hold(scope.stream);
  }
  return {places, admitted};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("project_rows_to_peers_", TORCH_BOX(&blitzgs::project_rows_to_peers)); }
#endif
