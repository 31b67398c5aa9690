// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <tuple>

#include "project/project_op.h"

#ifdef BLITZGS_BACKEND_CUDA
#include "common/stream_point.h"
#include "peers/peers_op.h"
#endif

namespace blitzgs {
namespace {

// The arguments that project_count and project_emit share.
struct Forward {
  Parameters p;
  OptionalTensor ids, views, active_count;
  std::int64_t candidates;
  ProjectOptions<double> options;
  RankTiles ranks;

  Forward(const char* op, const Tensor& means, const Tensor& quats, const Tensor& scales,
          const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats, const Tensor& Ks,
          const OptionalTensor& active_ids, const OptionalTensor& active_views, std::int64_t width,
          std::int64_t height, std::int64_t tile_size, std::int64_t sh_degree, double near_plane,
          double far_plane, double eps2d, double radius_clip, bool antialiased, bool raw,
          const std::vector<std::int64_t>& tile_begins, const std::vector<std::int64_t>& tile_ends,
          const OptionalTensor& n_active)
      : p(op, means, quats, scales, opacities, sh, viewmats, Ks, sh_degree),
        ids(contiguous_or_none(active_ids)),
        views(contiguous_or_none(active_views)),
        active_count(n_active),
        candidates(most_listed(op, active_count, ids ? ids->numel() : p.count)),
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
      check_shape(op, "active_views", *views, {ids ? ids->numel() : p.count});
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
    in.n_active = data_or_null<std::int32_t>(active_count);
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
    const std::vector<std::int64_t>& tile_ends, const OptionalTensor& active_count) {
  const Forward f("project_count", means, quats, scales, opacities, sh, viewmats, Ks, active_ids,
                  active_views, width, height, tile_size, sh_degree, near_plane, far_plane, eps2d,
                  radius_clip, antialiased, raw, tile_begins, tile_ends, active_count);
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

// Tensors for rows, in the order of RowTensors.
std::vector<Tensor> make_rows(const Forward& f, const ProjectSizes& room) {
  const std::int64_t U = room.visible, P = room.rows;
  const auto make = [&](std::vector<std::int64_t> shape, ScalarType dtype) {
    return make_empty(f.p.means, shape, dtype);
  };
  const auto ints = ScalarType::Int, dtype = f.p.means.scalar_type();
  return {make({P}, ints),     make({P}, ints),     make({U}, ints),
          make({U + 1}, ints), make({P, 2}, dtype), make({P, 3}, dtype),
          make({P}, dtype),    make({P}, dtype),    make({f.p.sh ? P : 0, 3}, dtype),
          make({P, 2}, ints),  make({P}, ints),     make({f.ranks.n_ranks > 0 ? P : 0}, ScalarType::Long)};
}

// Without the rows that turned out not to be needed.
void shorten(std::vector<Tensor>& rows, const ProjectSizes& sizes) {
  for (std::size_t i = 0; i < std::tuple_size_v<RowTensors>; ++i) {
    const std::int64_t length = i == 2 ? sizes.visible : i == 3 ? sizes.visible + 1 : sizes.rows;
    if (rows[i].size(0) > length) rows[i] = first_rows(rows[i], length);
  }
}

// Lists the rows of a plan and calls launch(inputs, ids, room, outputs) to have them written.
template <class F>
std::vector<Tensor> queue_rows(const Forward& f, const Tensor& plan, const std::int64_t* totals,
                               const ProjectSizes& sizes, DeviceScope& scope, const F& launch) {
  std::vector<Tensor> out = make_rows(f, sizes);
  const ProjectIds listed{mutable_data<std::int32_t>(out[0]), mutable_data<std::int32_t>(out[1]),
                          mutable_data<std::int32_t>(out[2]), mutable_data<std::int32_t>(out[3])};
  dispatch_floating(f.p.means, [&](auto zero) {
    using T = decltype(zero);
    const ProjectInputs<T> in = f.inputs<T>();
    const ProjectRoom room{sizes, totals};
    backend::project_list(in, plan.const_data_ptr(), room, listed, scope.workspace, scope.stream);
    const ProjectOutputs<T> rows{mutable_data<T>(out[4]),
                                 mutable_data<T>(out[5]),
                                 mutable_data<T>(out[6]),
                                 mutable_data<T>(out[7]),
                                 mutable_data<T>(out[8]),
                                 mutable_data<std::int32_t>(out[9]),
                                 mutable_data<std::int32_t>(out[10]),
                                 f.ranks.n_ranks > 0 ? mutable_data<std::int64_t>(out[11]) : nullptr};
    launch(in, listed, room, rows);
  });
  return out;
}

// Calls queue(room), which has the rows written that there is room for, and returns what that returns, of the
// length that `known` tells once the host was told. CUDA does not wait for this: rows are written into the
// room that was guessed, and written again in the rare case that it was too small. known() is called when
// what was queued before is done.
template <class Known, class Queue>
std::vector<Tensor> write_rows(const char* op, ProjectSizes room, [[maybe_unused]] CudaStream stream,
                               const Known& known, const Queue& queue) {
  std::vector<Tensor> rows;
#ifdef BLITZGS_BACKEND_CUDA
  const cuda::StreamPoint told(stream);
  if (room.visible > 0 && room.rows > 0) rows = queue(room);
  told.wait();
#endif
  const ProjectSizes sizes = known();
  STD_TORCH_CHECK(sizes.rows <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op, ": ", sizes.rows,
                  " rows (Gaussians seen, summed over views) exceed 2^31 - 1; project fewer views at a time");
  if (rows.empty() || sizes.visible > room.visible || sizes.rows > room.rows) rows = queue(sizes);
  shorten(rows, sizes);
  return rows;
}

RowTensors as_tuple(const std::vector<Tensor>& r) {
  return {r[0], r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8], r[9], r[10], r[11]};
}

RowTensors project_emit(const Tensor& means, const Tensor& quats, const Tensor& scales,
                        const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats,
                        const Tensor& Ks, const OptionalTensor& active_ids,
                        const OptionalTensor& active_views, std::int64_t width, std::int64_t height,
                        std::int64_t tile_size, std::int64_t sh_degree, double near_plane, double far_plane,
                        double eps2d, double radius_clip, bool antialiased, bool raw,
                        const std::vector<std::int64_t>& tile_begins,
                        const std::vector<std::int64_t>& tile_ends, const OptionalTensor& active_count,
                        const Tensor& plan, const Tensor& carry, const Tensor& totals, const Tensor& counts,
                        std::int64_t visible_room, std::int64_t row_room) {
  constexpr const char* kOp = "project_emit";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width,
                  height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
                  tile_begins, tile_ends, active_count);
  check_plan(kOp, f, plan);
  check_dtype(kOp, "totals", totals, ScalarType::Long);
  check_shape(kOp, "totals", totals, {project_totals(f.p.n_views, f.ranks.n_ranks)});
  check_dtype(kOp, "counts", counts, ScalarType::Long);
  STD_TORCH_CHECK(counts.is_cpu() && counts.numel() >= 2, "blitzgs::", kOp,
                  ": counts must be the totals of project_count, on the CPU");
  DeviceScope scope(f.p.means);
  const auto known = [&] {
    const auto* numbers = data<std::int64_t>(counts);
    return ProjectSizes{numbers[kTotalVisible], numbers[kTotalRows]};
  };
  const auto queue = [&](const ProjectSizes& sizes) {
    return queue_rows(f, plan, data<std::int64_t>(totals), sizes, scope,
                      [&](const auto& in, const ProjectIds& ids, const ProjectRoom& room, const auto& rows) {
                        backend::project_emit(in, f.ranks, carry.const_data_ptr(), ids, room, rows,
                                              scope.workspace, scope.stream);
                      });
  };
  return as_tuple(write_rows(kOp, {visible_room, row_room}, scope.stream, known, queue));
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
  // Most rows that any rank sends or gets.
  std::int64_t most() const {
    std::int64_t result = 0;
    for (int m = 0; m < n_ranks; ++m) {
      std::int64_t sent = 0, received = 0;
      for (int other = 0; other < n_ranks; ++other) sent += rows(m, other), received += rows(other, m);
      result = std::max({result, sent, received});
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
                                     const std::vector<std::int64_t>& tile_ends,
                                     const OptionalTensor& active_count, const Tensor& plan,
                                     const Tensor& everyone, const Tensor& counts, std::int64_t rank,
                                     const Tensor& ids, std::vector<Tensor> buffers, std::int64_t capacity,
                                     std::int64_t visible_room, std::int64_t row_room, double first_part) {
  constexpr const char* kOp = "project_emit_to_peers_";
  const Forward f(kOp, means, quats, scales, opacities, sh, viewmats, Ks, active_ids, active_views, width,
                  height, tile_size, sh_degree, near_plane, far_plane, eps2d, radius_clip, antialiased, raw,
                  tile_begins, tile_ends, active_count);
  check_plan(kOp, f, plan);
  const int n_ranks = f.ranks.n_ranks;
  const std::int64_t n_totals = project_totals(f.p.n_views, n_ranks);
  for (const Tensor& told : {everyone, counts}) {
    check_dtype(kOp, "everyone", told, ScalarType::Long);
    check_shape(kOp, "everyone", told, {n_ranks, n_totals});
    STD_TORCH_CHECK(told.is_contiguous(), "blitzgs::", kOp, ": everyone must be contiguous");
  }
  STD_TORCH_CHECK(!everyone.is_cpu() && counts.is_cpu() && rank >= 0 && rank < n_ranks, "blitzgs::", kOp,
                  ": everyone must be the totals of each rank on the GPU, counts the same on the CPU, and ",
                  "rank one of ", n_ranks, ", got ", rank);
  check_dtype(kOp, "ids", ids, ScalarType::Long);
  check_shape(kOp, "ids", ids, {f.p.count});
  STD_TORCH_CHECK(first_part >= 0 && first_part <= 1, "blitzgs::", kOp,
                  ": first_part must be in [0, 1], got ", first_part);
  const Tensor every_id = as_contiguous(ids);
  const ScatterTargets targets = peer_targets(kOp, buffers, kEmittedColumns, capacity, n_ranks);
  DeviceScope scope(f.p.means);
  const auto known = [&] {
    const auto* numbers = data<std::int64_t>(counts);
    const Announced announced{numbers, n_totals, kTotalViews + f.p.n_views, n_ranks};
    if (announced.most() > capacity) return ProjectSizes{0, 0};
    return ProjectSizes{numbers[rank * n_totals + kTotalVisible], numbers[rank * n_totals + kTotalRows]};
  };
  const auto* shown = data<std::int64_t>(everyone);
  const auto queue = [&](const ProjectSizes& sizes) {
    Tensor places = make_places(f.p.means, sizes.rows, n_ranks);
    Tensor filled = make_empty(f.p.means, {2, n_ranks}, ScalarType::Long);
    std::vector<Tensor> rows = queue_rows(
        f, plan, shown + rank * n_totals, sizes, scope,
        [&](const auto& in, const ProjectIds& listed, const ProjectRoom& room, const auto& out) {
          const ProjectScatter scatter{data<std::int64_t>(every_id),
                                       first_part,
                                       scope.workspace.template allocate<std::int64_t>(sizes.rows),
                                       mutable_data<std::int64_t>(filled),
                                       places_of(places),
                                       shown,
                                       n_ranks,
                                       static_cast<int>(rank),
                                       capacity,
                                       targets};
          cuda::project_emit_to_ranks(in, f.ranks, listed, room, out, scatter, scope.workspace, scope.stream);
        });
    rows.insert(rows.end(), {places, filled});
    return rows;
  };
  std::vector<Tensor> rows = write_rows(kOp, {visible_room, row_room}, scope.stream, known, queue);
  const std::int64_t runs = place_runs(rows[0].size(0));
  return std::tuple_cat(as_tuple(rows), std::tuple{first_rows(rows[12], runs), rows[13]});
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
