// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <tuple>

#include "project/project_op.h"

#ifdef BLITZGS_BACKEND_CUDA
#include "peers/peers_op.h"
#endif

namespace blitzgs {
namespace {

// The arguments that project_count and project_emit share.
struct Forward {
  Parameters p;
  OptionalTensor ids, views;
  std::int64_t candidates;
  ProjectOptions<double> options;
  RankTiles ranks;

  Forward(const char* op, const Tensor& means, const Tensor& quats, const Tensor& scales,
          const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats, const Tensor& Ks,
          const OptionalTensor& active_ids, const OptionalTensor& active_views, std::int64_t width,
          std::int64_t height, std::int64_t tile_size, std::int64_t sh_degree, double near_plane,
          double far_plane, double eps2d, double radius_clip, bool antialiased, bool raw,
          const std::vector<std::int64_t>& tile_begins, const std::vector<std::int64_t>& tile_ends)
      : p(op, means, quats, scales, opacities, sh, viewmats, Ks, sh_degree),
        ids(contiguous_or_none(active_ids)),
        views(contiguous_or_none(active_views)),
        candidates(ids ? ids->numel() : p.count),
        options{static_cast<int>(width),
                static_cast<int>(height),
                static_cast<int>(tile_size),
                static_cast<int>(sh_degree),
                static_cast<int>(p.sh_stride),
                near_plane,
                far_plane,
                eps2d,
                radius_clip,
                antialiased,
                raw},
        ranks{} {
    check_image(op, width, height);
    STD_TORCH_CHECK(tile_size > 0, "blitzgs::", op, ": tile_size must be positive, got ", tile_size);
    if (ids) {
      check_shape(op, "active_ids", *ids, {-1});
      check_dtype(op, "active_ids", *ids, ScalarType::Int);
    }
    if (views) {
      check_shape(op, "active_views", *views, {candidates});
      check_dtype(op, "active_views", *views, ScalarType::Int);
    }
    STD_TORCH_CHECK(tile_begins.size() == tile_ends.size() && tile_begins.size() <= kMaxRanks,
                    "blitzgs::", op, ": tile_begins and tile_ends must have one entry for each of at most ",
                    kMaxRanks, " ranks, got ", tile_begins.size(), " and ", tile_ends.size());
    ranks.n_ranks = static_cast<int>(tile_begins.size());
    std::copy(tile_begins.begin(), tile_begins.end(), ranks.begin);
    std::copy(tile_ends.begin(), tile_ends.end(), ranks.end);
  }

  template <class T>
  ProjectInputs<T> inputs() const {
    const auto& o = options;
    ProjectInputs<T> in =
        p.inputs<T>({o.width, o.height, o.tile_size, o.sh_degree, o.sh_stride, static_cast<T>(o.near_plane),
                     static_cast<T>(o.far_plane), static_cast<T>(o.eps2d), static_cast<T>(o.radius_clip),
                     o.antialiased, o.raw});
    in.active_ids = data_or_null<std::int32_t>(ids);
    in.active_views = data_or_null<std::int32_t>(views);
    in.n_candidates = candidates;
    return in;
  }
};

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

std::tuple<Tensor, Tensor, Tensor> project_count(
    const Tensor& means, const Tensor& quats, const Tensor& scales, const Tensor& opacities,
    const OptionalTensor& sh, const Tensor& viewmats, const Tensor& Ks, const OptionalTensor& active_ids,
    const OptionalTensor& active_views, std::int64_t width, std::int64_t height, std::int64_t tile_size,
    std::int64_t sh_degree, double near_plane, double far_plane, double eps2d, double radius_clip,
    bool antialiased, bool raw, const std::vector<std::int64_t>& tile_begins,
    const std::vector<std::int64_t>& tile_ends) {
  const Forward f("project_count", means, quats, scales, opacities, sh, viewmats, Ks, active_ids,
                  active_views, width, height, tile_size, sh_degree, near_plane, far_plane, eps2d,
                  radius_clip, antialiased, raw, tile_begins, tile_ends);
  const std::size_t bytes = backend::project_plan_bytes(f.candidates);
  Tensor plan = make_empty(f.p.means, {static_cast<std::int64_t>((bytes + 7) / 8)}, ScalarType::Long);
  Tensor totals = make_empty(f.p.means, {project_totals(f.p.n_views, f.ranks.n_ranks)}, ScalarType::Long);
  Carry carry(f.p.means);
  DeviceScope scope(f.p.means);
  dispatch_floating(f.p.means, [&](auto zero) {
    backend::project_count(f.inputs<decltype(zero)>(), f.ranks, plan.mutable_data_ptr(), carry,
                           mutable_data<std::int64_t>(totals), scope.workspace, scope.stream);
  });
  return {plan, carry.tensor(), totals};
}

using RowTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                              Tensor, Tensor>;

void check_plan(const char* op, const Forward& f, const Tensor& plan) {
  const auto bytes = static_cast<std::int64_t>(backend::project_plan_bytes(f.candidates));
  check_dtype(op, "plan", plan, ScalarType::Long);
  check_shape(op, "plan", plan, {(bytes + 7) / 8});
}

// Lists the rows of a plan and calls launch(inputs, ids, rows, outputs) to have them written.
template <class F>
RowTensors emit_rows(const char* op, const Forward& f, const Tensor& plan, const ProjectSizes& sizes,
                     DeviceScope& scope, const F& launch) {
  STD_TORCH_CHECK(sizes.rows <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op, ": ", sizes.rows,
                  " rows (Gaussians seen, summed over views) exceed 2^31 - 1; project fewer views at a time");
  const std::int64_t U = sizes.visible, P = sizes.rows;
  const auto ints = ScalarType::Int;
  Tensor gaussian_ids = make_empty(f.p.means, {P}, ints), camera_ids = make_empty(f.p.means, {P}, ints),
         visible_ids = make_empty(f.p.means, {U}, ints), row_offsets = make_empty(f.p.means, {U + 1}, ints);
  const ProjectIds listed{mutable_data<std::int32_t>(gaussian_ids), mutable_data<std::int32_t>(camera_ids),
                          mutable_data<std::int32_t>(visible_ids), mutable_data<std::int32_t>(row_offsets)};
  std::vector<Tensor> out;
  dispatch_floating(f.p.means, [&](auto zero) {
    using T = decltype(zero);
    const ProjectInputs<T> in = f.inputs<T>();
    backend::project_list(in, plan.const_data_ptr(), sizes, listed, scope.workspace, scope.stream);
    // Only now the other outputs: the device has waited for the sizes long enough.
    out = {make_empty(f.p.means, {P, 2}),
           make_empty(f.p.means, {P, 3}),
           make_empty(f.p.means, {P}),
           make_empty(f.p.means, {P}),
           make_empty(f.p.means, {f.p.sh ? P : 0, 3}),
           make_empty(f.p.means, {P, 2}, ints),
           make_empty(f.p.means, {P}, ints),
           make_empty(f.p.means, {f.ranks.n_ranks > 0 ? P : 0}, ScalarType::Long)};
    const ProjectOutputs<T> rows{mutable_data<T>(out[0]),
                                 mutable_data<T>(out[1]),
                                 mutable_data<T>(out[2]),
                                 mutable_data<T>(out[3]),
                                 mutable_data<T>(out[4]),
                                 mutable_data<std::int32_t>(out[5]),
                                 mutable_data<std::int32_t>(out[6]),
                                 f.ranks.n_ranks > 0 ? mutable_data<std::int64_t>(out[7]) : nullptr};
    launch(in, listed, P, rows);
  });
  return {gaussian_ids, camera_ids, visible_ids, row_offsets, out[0], out[1],
          out[2],       out[3],     out[4],      out[5],      out[6], out[7]};
}

RowTensors project_emit(const Tensor& means, const Tensor& quats, const Tensor& scales,
                        const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats,
                        const Tensor& Ks, const OptionalTensor& active_ids,
                        const OptionalTensor& active_views, std::int64_t width, std::int64_t height,
                        std::int64_t tile_size, std::int64_t sh_degree, double near_plane, double far_plane,
                        double eps2d, double radius_clip, bool antialiased, bool raw,
                        const std::vector<std::int64_t>& tile_begins,
                        const std::vector<std::int64_t>& tile_ends, const Tensor& plan, const Tensor& carry,
                        const Tensor& counts) {
  constexpr const char* kOp = "project_emit";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width,
                  height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
                  tile_begins, tile_ends);
  check_plan(kOp, f, plan);
  check_dtype(kOp, "counts", counts, ScalarType::Long);
  STD_TORCH_CHECK(counts.is_cpu() && counts.numel() >= 2, "blitzgs::", kOp,
                  ": counts must be the totals of project_count, on the CPU");
  DeviceScope scope(f.p.means);
  backend::project_wait(scope.stream);
  const auto* totals = data<std::int64_t>(counts);
  const auto write = [&](const auto& in, const ProjectIds& ids, std::int64_t n_rows, const auto& rows) {
    backend::project_emit(in, f.ranks, carry.const_data_ptr(), ids, n_rows, rows, scope.workspace,
                          scope.stream);
  };
  return emit_rows(kOp, f, plan, {totals[kTotalVisible], totals[kTotalRows]}, scope, write);
}

#ifdef BLITZGS_BACKEND_CUDA
using SentRowTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                                  Tensor, Tensor, Tensor, Tensor, Tensor>;

// What every rank's project_count summed up, [M, project_totals(B, M)] on the host.
struct Announced {
  const std::int64_t* totals;
  std::int64_t stride, first;
  int n_ranks;

  std::int64_t rows(int source, int target) const { return totals[source * stride + first + 2 * target]; }
  // Rows that go to `target` from the ranks before `end`.
  std::int64_t before(int target, int end) const {
    std::int64_t sum = 0;
    for (int source = 0; source < end; ++source) sum += rows(source, target);
    return sum;
  }
  // Most rows that any rank sends or gets.
  std::int64_t most() const {
    std::int64_t result = 0;
    for (int m = 0; m < n_ranks; ++m) {
      std::int64_t sent = 0;
      for (int target = 0; target < n_ranks; ++target) sent += rows(m, target);
      result = std::max({result, sent, before(m, n_ranks)});
    }
    return result;
  }
};

SentRowTensors project_emit_to_peers(const Tensor& means, const Tensor& quats, const Tensor& scales,
                                     const Tensor& opacities, const Tensor& sh, const Tensor& viewmats,
                                     const Tensor& Ks, const OptionalTensor& active_ids,
                                     const OptionalTensor& active_views, std::int64_t width,
                                     std::int64_t height, std::int64_t tile_size, std::int64_t sh_degree,
                                     double near_plane, double far_plane, double eps2d, double radius_clip,
                                     bool antialiased, bool raw, const std::vector<std::int64_t>& tile_begins,
                                     const std::vector<std::int64_t>& tile_ends, const Tensor& plan,
                                     const Tensor& everyone, std::int64_t rank, const Tensor& ids,
                                     std::vector<Tensor> buffers, std::int64_t capacity, double first_part) {
  constexpr const char* kOp = "project_emit_to_peers_";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width,
                  height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
                  tile_begins, tile_ends);
  check_plan(kOp, f, plan);
  const int n_ranks = f.ranks.n_ranks, me = static_cast<int>(rank);
  const std::int64_t n_totals = project_totals(f.p.n_views, n_ranks);
  check_dtype(kOp, "everyone", everyone, ScalarType::Long);
  check_shape(kOp, "everyone", everyone, {n_ranks, n_totals});
  STD_TORCH_CHECK(everyone.is_cpu() && everyone.is_contiguous() && rank >= 0 && rank < n_ranks,
                  "blitzgs::", kOp,
                  ": everyone must be the totals of each rank, contiguous on the CPU, and rank one of ",
                  n_ranks, ", got ", rank);
  check_dtype(kOp, "ids", ids, ScalarType::Long);
  check_shape(kOp, "ids", ids, {f.p.count});
  STD_TORCH_CHECK(first_part >= 0 && first_part <= 1, "blitzgs::", kOp,
                  ": first_part must be in [0, 1], got ", first_part);
  const Tensor every_id = as_contiguous(ids);
  DeviceScope scope(f.p.means);
  backend::project_wait(scope.stream);
  const Announced announced{data<std::int64_t>(everyone), n_totals, kTotalViews + f.p.n_views, n_ranks};
  std::vector<std::int64_t> group_sizes(n_ranks), starts(n_ranks);
  ProjectSizes sizes{};
  if (announced.most() <= capacity) {
    const std::int64_t* mine = announced.totals + rank * n_totals;
    sizes = {mine[kTotalVisible], mine[kTotalRows]};
    for (int m = 0; m < n_ranks; ++m) {
      group_sizes[m] = announced.rows(me, m);
      starts[m] = announced.before(m, me);
    }
  }
  const RowGroups groups = checked_groups(kOp, "everyone", group_sizes);
  Tensor row_ids, places, filled = make_empty(f.p.means, {2, n_ranks}, ScalarType::Long);
  const auto first_visible = static_cast<std::int64_t>(first_part * static_cast<double>(sizes.visible));
  const auto send = [&](const auto& in, const ProjectIds& listed, std::int64_t n_rows, const auto& out) {
    row_ids = make_empty(f.p.means, {n_rows}, ScalarType::Long);
    places = make_places(f.p.means, n_rows, groups);
    const ProjectScatter scatter{data<std::int64_t>(every_id),
                                 first_visible,
                                 mutable_data<std::int64_t>(row_ids),
                                 mutable_data<std::int64_t>(filled),
                                 places_of(places),
                                 groups,
                                 peer_targets(kOp, buffers, kEmittedColumns, capacity, starts, groups)};
    cuda::project_emit_to_ranks(in, f.ranks, listed, n_rows, out, scatter, scope.workspace, scope.stream);
  };
  auto rows = emit_rows(kOp, f, plan, sizes, scope, send);
  return std::tuple_cat(std::move(rows), std::tuple{places, filled});
}
#endif

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("project_count", TORCH_BOX(&blitzgs::project_count));
  m.impl("project_emit", TORCH_BOX(&blitzgs::project_emit));
#ifdef BLITZGS_BACKEND_CUDA
  m.impl("project_emit_to_peers_", TORCH_BOX(&blitzgs::project_emit_to_peers));
#endif
}
