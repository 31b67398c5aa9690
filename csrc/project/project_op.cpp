// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <limits>
#include <tuple>

#include "common/op.h"
#include "project/project.h"

namespace blitzgs {
namespace {

using OptionalTensor = std::optional<Tensor>;

// The contiguous inputs of both directions, checked. Held here so that the raw pointers stay valid.
struct Parameters {
  Tensor means, quats, scales, opacities, viewmats, Ks;
  OptionalTensor sh;
  std::int64_t count, n_views, sh_stride;

  Parameters(const char* op, const Tensor& means_in, const Tensor& quats_in, const Tensor& scales_in,
             const Tensor& opacities_in, const OptionalTensor& sh_in, const Tensor& viewmats_in,
             const Tensor& Ks_in, std::int64_t sh_degree)
      : means(as_contiguous(means_in)),
        quats(as_contiguous(quats_in)),
        scales(as_contiguous(scales_in)),
        opacities(as_contiguous(opacities_in)),
        viewmats(as_contiguous(viewmats_in)),
        Ks(as_contiguous(Ks_in)),
        sh(sh_in ? OptionalTensor(as_contiguous(*sh_in)) : std::nullopt) {
    check_floating(op, "means", means);
    check_shape(op, "means", means, {-1, 3});
    check_shape(op, "viewmats", viewmats, {-1, 4, 4});
    count = means.size(0);
    n_views = viewmats.size(0);
    sh_stride = sh && sh->dim() == 3 ? sh->size(1) : 0;
    check_shape(op, "quats", quats, {count, 4});
    check_shape(op, "scales", scales, {count, 3});
    check_shape(op, "opacities", opacities, {count});
    check_shape(op, "Ks", Ks, {n_views, 3, 3});
    const ScalarType dtype = means.scalar_type();
    check_dtype(op, "quats", quats, dtype);
    check_dtype(op, "scales", scales, dtype);
    check_dtype(op, "opacities", opacities, dtype);
    check_dtype(op, "viewmats", viewmats, dtype);
    check_dtype(op, "Ks", Ks, dtype);
    STD_TORCH_CHECK(n_views <= kMaxViews, "blitzgs::", op, ": at most ", kMaxViews,
                    " views in one launch, got ", n_views, "; call it for fewer views at a time");
    STD_TORCH_CHECK(count <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op,
                    ": at most 2^31 - 1 Gaussians on one device, got ", count);
    if (sh) {
      check_shape(op, "sh", *sh, {count, -1, 3});
      check_dtype(op, "sh", *sh, dtype);
      STD_TORCH_CHECK(sh_degree >= 0 && sh_degree <= kMaxShDegree, "blitzgs::", op,
                      ": sh_degree must be 0 to 3, got ", sh_degree);
      STD_TORCH_CHECK(sh_basis_count(static_cast<int>(sh_degree)) <= sh_stride, "blitzgs::", op, ": sh has ",
                      sh_stride, " coefficients, sh_degree ", sh_degree, " needs ",
                      sh_basis_count(static_cast<int>(sh_degree)));
    }
  }

  template <class T>
  ProjectInputs<T> inputs(const ProjectOptions<T>& options) const {
    return {data<T>(means),
            data<T>(quats),
            data<T>(scales),
            data<T>(opacities),
            data_or_null<T>(sh),
            data<T>(viewmats),
            data<T>(Ks),
            nullptr,
            nullptr,
            count,
            static_cast<int>(n_views),
            options};
  }
};

void check_image(const char* op, std::int64_t width, std::int64_t height) {
  STD_TORCH_CHECK(width > 0 && height > 0 && width < (1 << 24) && height < (1 << 24), "blitzgs::", op,
                  ": width and height must be in [1, 2^24), got ", width, " x ", height);
}

OptionalTensor contiguous_or_none(const OptionalTensor& tensor) {
  return tensor ? OptionalTensor(as_contiguous(*tensor)) : std::nullopt;
}

// The arguments that project_count and project_emit share.
struct Forward {
  Parameters p;
  OptionalTensor ids, views;
  std::int64_t candidates;
  ProjectOptions<double> options;
  RankTiles ranges;

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
        ranges{} {
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
    ranges.n_ranks = static_cast<int>(tile_begins.size());
    std::copy(tile_begins.begin(), tile_begins.end(), ranges.begin);
    std::copy(tile_ends.begin(), tile_ends.end(), ranges.end);
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
  Tensor totals = make_empty(f.p.means, {project_totals(f.p.n_views, f.ranges.n_ranks)}, ScalarType::Long);
  Carry carry(f.p.means);
  DeviceScope scope(f.p.means);
  dispatch_floating(f.p.means, [&](auto zero) {
    backend::project_count(f.inputs<decltype(zero)>(), f.ranges, plan.mutable_data_ptr(), carry,
                           mutable_data<std::int64_t>(totals), scope.workspace, scope.stream);
  });
  return {plan, carry.tensor(), totals};
}

using RowTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                              Tensor, Tensor>;

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
  const auto bytes = static_cast<std::int64_t>(backend::project_plan_bytes(f.candidates));
  check_dtype(kOp, "plan", plan, ScalarType::Long);
  check_shape(kOp, "plan", plan, {(bytes + 7) / 8});
  check_dtype(kOp, "counts", counts, ScalarType::Long);
  STD_TORCH_CHECK(counts.is_cpu() && counts.numel() >= 2,
                  "blitzgs::project_emit: counts must be the totals of project_count, on the CPU");
  const auto* totals = data<std::int64_t>(counts);
  const ProjectSizes sizes{totals[kTotalVisible], totals[kTotalRows]};
  STD_TORCH_CHECK(sizes.rows <= std::numeric_limits<std::int32_t>::max(),
                  "blitzgs::project_emit: ", sizes.rows,
                  " rows (Gaussians seen, summed over views) exceed 2^31 - 1; project fewer views at a time");
  const std::int64_t U = sizes.visible, P = sizes.rows;
  const auto ints = ScalarType::Int;
  std::vector<Tensor> out{make_empty(f.p.means, {P}, ints),
                          make_empty(f.p.means, {P}, ints),
                          make_empty(f.p.means, {U}, ints),
                          make_empty(f.p.means, {U + 1}, ints),
                          make_empty(f.p.means, {P, 2}),
                          make_empty(f.p.means, {P, 3}),
                          make_empty(f.p.means, {P}),
                          make_empty(f.p.means, {P}),
                          make_empty(f.p.means, {sh ? P : 0, 3}),
                          make_empty(f.p.means, {P, 2}, ints),
                          make_empty(f.p.means, {P}, ints),
                          make_empty(f.p.means, {f.ranges.n_ranks > 0 ? P : 0}, ScalarType::Long)};
  DeviceScope scope(f.p.means);
  dispatch_floating(f.p.means, [&](auto zero) {
    using T = decltype(zero);
    const ProjectOutputs<T> rows{mutable_data<std::int32_t>(out[0]),
                                 mutable_data<std::int32_t>(out[1]),
                                 mutable_data<std::int32_t>(out[2]),
                                 mutable_data<std::int32_t>(out[3]),
                                 mutable_data<T>(out[4]),
                                 mutable_data<T>(out[5]),
                                 mutable_data<T>(out[6]),
                                 mutable_data<T>(out[7]),
                                 mutable_data<T>(out[8]),
                                 mutable_data<std::int32_t>(out[9]),
                                 mutable_data<std::int32_t>(out[10]),
                                 f.ranges.n_ranks > 0 ? mutable_data<std::int64_t>(out[11]) : nullptr};
    backend::project_emit(f.inputs<T>(), f.ranges, plan.const_data_ptr(), carry.const_data_ptr(), sizes, rows,
                          scope.workspace, scope.stream);
  });
  return {out[0], out[1], out[2], out[3], out[4], out[5], out[6], out[7], out[8], out[9], out[10], out[11]};
}

using BackwardTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

BackwardTensors project_bwd(const Tensor& means, const Tensor& quats, const Tensor& scales,
                            const Tensor& opacities, const OptionalTensor& sh, const Tensor& viewmats,
                            const Tensor& Ks, const Tensor& camera_ids, const Tensor& visible_ids,
                            const Tensor& row_offsets, std::int64_t width, std::int64_t height,
                            std::int64_t sh_degree, double eps2d, bool antialiased, bool raw,
                            const Tensor& v_means2d, const Tensor& v_conics, const OptionalTensor& v_depths,
                            const Tensor& v_row_opacities, const OptionalTensor& v_colors,
                            const OptionalTensor& scale_reg, bool need_viewmats) {
  constexpr const char* kOp = "project_bwd";
  const Parameters p(kOp, means, quats, scales, opacities, sh, viewmats, Ks, sh_degree);
  check_image(kOp, width, height);
  const std::int64_t U = visible_ids.numel(), P = camera_ids.numel();
  const ScalarType dtype = p.means.scalar_type();
  check_dtype(kOp, "camera_ids", camera_ids, ScalarType::Int);
  check_dtype(kOp, "visible_ids", visible_ids, ScalarType::Int);
  check_dtype(kOp, "row_offsets", row_offsets, ScalarType::Int);
  check_shape(kOp, "row_offsets", row_offsets, {U + 1});
  check_shape(kOp, "v_means2d", v_means2d, {P, 2});
  check_shape(kOp, "v_conics", v_conics, {P, 3});
  check_shape(kOp, "v_row_opacities", v_row_opacities, {P});
  if (v_depths) check_shape(kOp, "v_depths", *v_depths, {P});
  if (v_colors) check_shape(kOp, "v_colors", *v_colors, {P, 3});
  if (scale_reg) check_shape(kOp, "scale_reg", *scale_reg, {p.n_views});
  const Tensor cameras = as_contiguous(camera_ids), ids = as_contiguous(visible_ids),
               offsets = as_contiguous(row_offsets), v_xy = as_contiguous(v_means2d),
               v_conic = as_contiguous(v_conics), v_opacity = as_contiguous(v_row_opacities);
  const OptionalTensor v_depth = contiguous_or_none(v_depths), v_color = contiguous_or_none(v_colors),
                       weights = contiguous_or_none(scale_reg);
  for (const Tensor* v : {&v_xy, &v_conic, &v_opacity}) check_dtype(kOp, "row gradients", *v, dtype);
  for (const OptionalTensor* v : {&v_depth, &v_color, &weights}) {
    if (*v) check_dtype(kOp, "row gradients and scale_reg", **v, dtype);
  }
  Tensor v_means = make_empty(p.means, {U, 3}), v_quats = make_empty(p.means, {U, 4}),
         v_scales = make_empty(p.means, {U, 3}), v_opacities = make_empty(p.means, {U}),
         v_sh = make_empty(p.means, {U, p.sh_stride, 3}),
         v_viewmats = make_empty(p.means, {need_viewmats ? p.n_views : 0, 4, 4});
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&](auto zero) {
    using T = decltype(zero);
    ProjectOptions<T> options{};
    options.width = static_cast<int>(width);
    options.height = static_cast<int>(height);
    options.sh_degree = static_cast<int>(sh_degree);
    options.sh_stride = static_cast<int>(p.sh_stride);
    options.eps2d = static_cast<T>(eps2d);
    options.antialiased = antialiased;
    options.raw = raw;
    backend::project_bwd(
        p.inputs<T>(options),
        ProjectRows{data<std::int32_t>(cameras), data<std::int32_t>(ids), data<std::int32_t>(offsets), U},
        ProjectRowGradients<T>{data<T>(v_xy), data<T>(v_conic), data_or_null<T>(v_depth), data<T>(v_opacity),
                               data_or_null<T>(v_color)},
        data_or_null<T>(weights),
        ProjectGradients<T>{mutable_data<T>(v_means), mutable_data<T>(v_quats), mutable_data<T>(v_scales),
                            mutable_data<T>(v_opacities), sh ? mutable_data<T>(v_sh) : nullptr,
                            need_viewmats ? mutable_data<T>(v_viewmats) : nullptr},
        scope.workspace, scope.stream);
  });
  return {v_means, v_quats, v_scales, v_opacities, v_sh, v_viewmats};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("project_count", TORCH_BOX(&blitzgs::project_count));
  m.impl("project_emit", TORCH_BOX(&blitzgs::project_emit));
  m.impl("project_bwd", TORCH_BOX(&blitzgs::project_bwd));
}
