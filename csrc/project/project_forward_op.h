// SPDX-License-Identifier: Apache-2.0
// What the ops of the projection's forward pass share: their arguments, and the tensors of rows.
#pragma once
#include <algorithm>
#include <vector>

#include "project/project_op.h"

namespace blitzgs {

// The arguments that all ops of the forward pass share.
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

// Rows of a frame: gaussian_ids, camera_ids, visible_ids, row_offsets, means2d, conics, depths, opacities,
// colors, radii, tiles_touched, rank_masks and, last, row_ids.
using RowList = std::vector<Tensor>;
inline constexpr std::size_t kVisibleIds = 2, kRowOffsets = 3, kRowTensors = 13;

inline RowList make_rows(const Forward& f, const ProjectSizes& room, bool with_ids) {
  const std::int64_t U = room.visible, P = room.rows;
  const auto make = [&](std::vector<std::int64_t> shape, ScalarType dtype) {
    return make_empty(f.p.means, shape, dtype);
  };
  const auto ints = ScalarType::Int, longs = ScalarType::Long, dtype = f.p.means.scalar_type();
  return {make({P}, ints),
          make({P}, ints),
          make({U}, ints),
          make({U + 1}, ints),
          make({P, 2}, dtype),
          make({P, 3}, dtype),
          make({P}, dtype),
          make({P}, dtype),
          make({f.p.sh ? P : 0, 3}, dtype),
          make({P, 2}, ints),
          make({P}, ints),
          make({f.ranks.n_ranks > 0 ? P : 0}, longs),
          make({with_ids ? P : 0}, longs)};
}

inline ProjectIds row_ids(RowList& rows) {
  return {mutable_data<std::int32_t>(rows[0]), mutable_data<std::int32_t>(rows[1]),
          mutable_data<std::int32_t>(rows[kVisibleIds]), mutable_data<std::int32_t>(rows[kRowOffsets])};
}

template <class T>
ProjectOutputs<T> row_values(const Forward& f, RowList& rows, const OptionalTensor& ids) {
  return {mutable_data<T>(rows[4]),
          mutable_data<T>(rows[5]),
          mutable_data<T>(rows[6]),
          mutable_data<T>(rows[7]),
          mutable_data<T>(rows[8]),
          mutable_data<std::int32_t>(rows[9]),
          mutable_data<std::int32_t>(rows[10]),
          f.ranks.n_ranks > 0 ? mutable_data<std::int64_t>(rows[11]) : nullptr,
          ids ? mutable_data<std::int64_t>(rows[12]) : nullptr,
          data_or_null<std::int64_t>(ids)};
}

// How many rows there is room for.
inline ProjectSizes room_of(const RowList& rows) {
  return rows.empty() ? ProjectSizes{0, 0} : ProjectSizes{rows[kVisibleIds].size(0), rows[0].size(0)};
}

inline OptionalTensor checked_ids(const char* op, const Forward& f, const OptionalTensor& ids) {
  if (!ids) return std::nullopt;
  check_dtype(op, "ids", *ids, ScalarType::Long);
  check_shape(op, "ids", *ids, {f.p.count});
  return as_contiguous(*ids);
}

inline void check_plan(const char* op, const Forward& f, const Tensor& plan) {
  const auto bytes = static_cast<std::int64_t>(backend::project_plan_bytes(f.candidates));
  check_dtype(op, "plan", plan, ScalarType::Long);
  check_shape(op, "plan", plan, {(bytes + 7) / 8});
}

// Rows as project_count returned them.
inline void check_rows(const char* op, const Forward& f, const RowList& rows) {
  if (rows.empty()) return;
  STD_TORCH_CHECK(rows.size() == kRowTensors && rows[0].device() == f.p.means.device(), "blitzgs::", op,
                  ": rows must be those of project_count");
}

}  // namespace blitzgs
