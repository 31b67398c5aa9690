// SPDX-License-Identifier: Apache-2.0
#include "project/project_op.h"

#include <algorithm>
#include <tuple>

namespace blitzgs {
namespace {

// The candidates of a projection: ids, the views that may see each, the number of valid ids, and the number
// of blocks of the table to which they belong. Without ids, all Gaussians in all views are candidates.
struct Candidates {
  OptionalTensor ids, views, listed, blocks;
  std::int64_t count;

  Candidates(const char* op, const OptionalTensor& active_ids, const OptionalTensor& active_views,
             const OptionalTensor& n_active, const OptionalTensor& n_blocks, std::int64_t n_gaussians)
      : count(n_gaussians) {
    STD_TORCH_CHECK(active_ids || (!active_views && !n_active && !n_blocks), "blitzgs::", op,
                    ": active_views, n_active and n_blocks need active_ids");
    if (!active_ids) return;
    ids = checked(op, "active_ids", active_ids, ScalarType::Int, {-1});
    const std::int64_t length = ids->numel();
    views = checked(op, "active_views", active_views, ScalarType::Int, {length});
    listed = n_active;
    blocks = checked(op, "n_blocks", n_blocks, ScalarType::Int, {1});
    count = max_listed(op, listed, length);
  }
};

RankTiles checked_rank_tiles(const char* op, const IntList& begins_and_ends) {
  const std::size_t n_ranks = begins_and_ends.size() / 2;
  STD_TORCH_CHECK(begins_and_ends.size() == 2 * n_ranks && n_ranks <= kMaxRanks, "blitzgs::", op,
                  ": rank_tiles must have a begin and an end for each of at most ", kMaxRanks, " ranks, got ",
                  begins_and_ends.size(), " numbers");
  RankTiles ranks{};
  ranks.n_ranks = static_cast<int>(n_ranks);
  for (std::size_t m = 0; m < n_ranks; ++m) {
    ranks.begin[m] = begins_and_ends[2 * m];
    ranks.end[m] = begins_and_ends[2 * m + 1];
  }
  return ranks;
}

// The columns of the splats as tensors, in the order in which the op returns them.
struct SplatTensors {
  Tensor gaussian_ids, camera_ids, visible_ids, splat_offsets, means2d, conics, depths, opacities, colors,
      radii, tiles_touched, rank_masks, splat_ids;
};

template <class T>
class TorchSplats final : public SplatMemory<T> {
 public:
  // ids: the persistent ids of the Gaussians; none: the ids of the splats are not wanted.
  TorchSplats(const Tensor& like, bool with_colors, bool with_masks, const OptionalTensor& ids,
              const std::optional<ProjectSizes>& capacity, SplatTensors* tensors)
      : like_(like),
        with_colors_(with_colors),
        with_masks_(with_masks),
        ids_(ids),
        capacity_(capacity),
        t_(*tensors) {}

  const ProjectSizes* capacity() const override { return capacity_ ? &*capacity_ : nullptr; }

  ProjectColumns<T> allocate(const ProjectSizes& sizes) override {
    const std::int64_t U = sizes.visible, P = sizes.splats;
    STD_TORCH_CHECK(
        P <= std::numeric_limits<std::int32_t>::max(), "blitzgs::project_fwd: ", P,
        " splats (Gaussians seen, summed over views) exceed 2^31 - 1; project fewer views at a time");
    // The braces guarantee that memory is allocated in this order.
    return {{ints(t_.gaussian_ids, {P}), ints(t_.camera_ids, {P}), ints(t_.visible_ids, {U}),
             ints(t_.splat_offsets, {U + 1})},
            {floats(t_.means2d, {P, 2}), floats(t_.conics, {P, 3}), floats(t_.depths, {P}),
             floats(t_.opacities, {P}), floats(t_.colors, {with_colors_ ? P : 0, 3}), ints(t_.radii, {P, 2}),
             ints(t_.tiles_touched, {P}), longs_if(with_masks_, t_.rank_masks, P),
             longs_if(ids_.has_value(), t_.splat_ids, P), data_or_null<std::int64_t>(ids_)}};
  }

 private:
  // Each makes a column and returns its memory.
  T* floats(Tensor& column, const std::vector<std::int64_t>& shape) {
    column = make_empty(like_, shape);
    return mutable_data<T>(column);
  }
  std::int32_t* ints(Tensor& column, const std::vector<std::int64_t>& shape) {
    column = make_empty(like_, shape, ScalarType::Int);
    return mutable_data<std::int32_t>(column);
  }
  // Null, and an empty column, if it is not wanted.
  std::int64_t* longs_if(bool wanted, Tensor& column, std::int64_t length) {
    column = make_empty(like_, {wanted ? length : 0}, ScalarType::Long);
    return wanted ? mutable_data<std::int64_t>(column) : nullptr;
  }

  const Tensor& like_;
  bool with_colors_, with_masks_;
  const OptionalTensor& ids_;
  std::optional<ProjectSizes> capacity_;
  SplatTensors& t_;
};

std::optional<ProjectSizes> checked_capacity(const char* op, std::optional<std::int64_t> visible,
                                             std::optional<std::int64_t> splats) {
  STD_TORCH_CHECK(
      visible.has_value() == splats.has_value() && visible.value_or(1) > 0 && splats.value_or(1) > 0,
      "blitzgs::", op,
      ": capacity must be how many visible Gaussians and splats there is room for, at least 1 each");
  if (!visible) return std::nullopt;
  return ProjectSizes{*visible, *splats};
}

using Projected = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                             Tensor, Tensor, Tensor, Tensor>;

Projected project_fwd(const TensorList& gaussians, const Tensor& viewmats, const Tensor& Ks,
                      const OptionalTensor& active_ids, const OptionalTensor& active_views,
                      const OptionalTensor& n_active, const OptionalTensor& n_blocks,
                      const OptionalTensor& ids, const OptionalTensor& level, std::int64_t width,
                      std::int64_t height, std::int64_t tile_size, std::int64_t sh_degree, double near_plane,
                      double far_plane, double eps2d, double radius_clip, bool antialiased, bool raw,
                      const FloatList& fade, const IntList& rank_tiles,
                      std::optional<std::int64_t> visible_capacity,
                      std::optional<std::int64_t> splat_capacity) {
  constexpr const char* kOp = "project_fwd";
  const ProjectArguments p(kOp, gaussians, viewmats, Ks,
                           checked_options(kOp, width, height, tile_size, sh_degree, near_plane, far_plane,
                                           eps2d, radius_clip, antialiased, raw, fade),
                           fade, level);
  const Candidates candidates(kOp, active_ids, active_views, n_active, n_blocks, p.count);
  const RankTiles ranks = checked_rank_tiles(kOp, rank_tiles);
  const std::optional<ProjectSizes> sizes = checked_capacity(kOp, visible_capacity, splat_capacity);
  const OptionalTensor persistent = checked(kOp, "ids", ids, ScalarType::Long, {p.count});
  Tensor totals = make_empty(p.means, {project_totals(p.n_views, ranks.n_ranks)}, ScalarType::Long);
  SplatTensors t;
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    ProjectInputs<T> in = p.inputs<T>();
    in.active_ids = data_or_null<std::int32_t>(candidates.ids);
    in.active_views = data_or_null<std::int32_t>(candidates.views);
    in.n_candidates = candidates.count;
    in.n_active = data_or_null<std::int32_t>(candidates.listed);
    in.n_blocks = data_or_null<std::int32_t>(candidates.blocks);
    TorchSplats<T> splats(p.means, p.sh.has_value(), ranks.n_ranks > 0, persistent, sizes, &t);
    backend::project(in, ranks, splats, mutable_data<std::int64_t>(totals), scope.workspace, scope.stream);
  });
  return {t.gaussian_ids, t.camera_ids, t.visible_ids, t.splat_offsets, t.means2d,    t.conics,    t.depths,
          t.opacities,    t.colors,     t.radii,       t.tiles_touched, t.rank_masks, t.splat_ids, totals};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("project_fwd", TORCH_BOX(&blitzgs::project_fwd)); }
