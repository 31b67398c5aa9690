// SPDX-License-Identifier: Apache-2.0
#include "project/project.h"

#include "adam/lazy_adam_op.h"
#include "project/project_op.h"

namespace blitzgs {
namespace {

RankTiles checked_rank_tiles(const IntList& begins_and_ends) {
  const size_t n_ranks = begins_and_ends.size() / 2;
  BLITZGS_CHECK(begins_and_ends.size() == 2 * n_ranks && n_ranks <= kMaxRanks,
                "rank_tiles must have a begin and an end for each of at most ", kMaxRanks, " ranks, got ",
                begins_and_ends.size(), " numbers");
  RankTiles ranks{};
  ranks.n_ranks = int(n_ranks);
  for (size_t m = 0; m < n_ranks; ++m) {
    ranks.begin[m] = begins_and_ends[2 * m];
    ranks.end[m] = begins_and_ends[2 * m + 1];
  }
  return ranks;
}

// The columns of the splats, in the order in which the op returns them, and the totals.
Tensors<14> project_fwd(const TensorList& gaussians, const Tensor& viewmats, const Tensor& Ks,
                        const OptionalTensor& active_ids, const OptionalTensor& active_views,
                        const OptionalTensor& n_active, const OptionalTensor& n_blocks,
                        const OptionalTensor& ids, const OptionalTensor& level, BLITZGS_PROJECT_OPTIONS,
                        const FloatList& fade, const IntList& rank_tiles,
                        std::optional<int64_t> visible_capacity, std::optional<int64_t> splat_capacity) {
  const ProjectArguments p(gaussians, viewmats, Ks, checked_options(BLITZGS_PROJECT_OPTION_NAMES, fade), fade,
                           level);
  // Without active_ids, all Gaussians in all views are candidates.
  BLITZGS_CHECK(active_ids || (!active_views && !n_active && !n_blocks),
                "active_views, n_active and n_blocks need active_ids");
  const auto candidates = checked<int32_t>("active_ids", active_ids, {-1});
  const int64_t length = candidates ? candidates->numel() : p.count;
  const auto candidate_views = checked<int32_t>("active_views", active_views, {length}),
             blocks = checked<int32_t>("n_blocks", n_blocks, {1});
  const int64_t listed = max_listed(n_active, length);
  const RankTiles ranks = checked_rank_tiles(rank_tiles);
  BLITZGS_CHECK(visible_capacity.has_value() == splat_capacity.has_value() &&
                    visible_capacity.value_or(1) > 0 && splat_capacity.value_or(1) > 0,
                "capacity must be how many visible Gaussians and splats there is room for, at least 1 each");
  const ProjectSizes capacity{visible_capacity.value_or(0), splat_capacity.value_or(0)};
  const auto persistent = checked<int64_t>("ids", ids, {p.count});
  const auto totals = make<int64_t>(p.means, {project_totals(p.n_views, ranks.n_ranks)});
  std::array<Tensor, 13> columns;
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&]<class T>() {
    ProjectInputs<T> in = p.inputs<T>();
    in.active_ids = candidates;
    in.active_views = candidate_views;
    in.n_candidates = listed;
    in.n_active = data_or_null<int32_t>(n_active);
    in.n_blocks = blocks;
    const auto memory = [&](const ProjectSizes& needed) -> ProjectColumns<T> {
      const int64_t U = needed.visible, P = needed.splats;
      BLITZGS_CHECK(
          P <= INT32_MAX, P,
          " splats (Gaussians seen, summed over views) exceed 2^31 - 1; project fewer views at a time");
      const bool with_masks = ranks.n_ranks > 0, with_ids = persistent.has_value();
      auto next = columns.begin();
      const auto add = [&](auto zero, const IntList& shape) {
        const auto values = make<decltype(zero)>(p.means, shape);
        *next++ = values;
        return values;
      };
      constexpr int32_t kInt = 0;
      constexpr int64_t kLong = 0;
      constexpr T kReal = 0;
      // The braces guarantee the order of the calls.
      return {{add(kInt, {P}), add(kInt, {P}), add(kInt, {U}), add(kInt, {U + 1})},
              {add(kReal, {P, 2}), add(kReal, {P, 3}), add(kReal, {P}), add(kReal, {P}),
               add(kReal, {p.sh ? P : 0, 3}), add(kInt, {P, 2}), add(kInt, {P}),
               add(kLong, {with_masks ? P : 0}).data_if(with_masks),
               add(kLong, {with_ids ? P : 0}).data_if(with_ids), persistent}};
    };
    backend::project<T>(in, ranks, visible_capacity ? &capacity : nullptr, memory, totals, scope.workspace,
                        scope.stream);
  });
  return std::tuple_cat(columns, std::tuple<Tensor>(totals));
}

// The outputs of the forward pass that both ops read, the weights of the regularisers for each view, and the
// gradients of the splats. The object holds the tensors, so that the raw pointers stay valid.
struct BackwardInputs {
  Values<const int32_t> camera_ids, visible_ids, splat_offsets;
  OptionalTensor scale_reg, opacity_reg, v_depths;
  TensorList v_splats;

  BackwardInputs(const ProjectArguments& p, const Tensor& camera_ids_in, const Tensor& visible_ids_in,
                 const Tensor& splat_offsets_in, const OptionalTensor& scale_reg_in,
                 const OptionalTensor& opacity_reg_in, const TensorList& v_splats_in,
                 const OptionalTensor& v_depths_in = std::nullopt)
      : camera_ids(checked<int32_t>("camera_ids", camera_ids_in, {-1})),
        visible_ids(checked<int32_t>("visible_ids", visible_ids_in, {-1})),
        splat_offsets(checked<int32_t>("splat_offsets", splat_offsets_in, {visible() + 1})),
        v_splats(v_splats_in) {
    const ScalarType dtype = p.means.scalar_type();
    scale_reg = checked("scale_reg", scale_reg_in, dtype, {p.n_views});
    opacity_reg = checked("opacity_reg", opacity_reg_in, dtype, {p.n_views});
    const int64_t splats = camera_ids.numel();
    BLITZGS_CHECK(kOnCuda || !in_table(), "a table of gradients needs CUDA; give columns");
    if (in_table()) {
      BLITZGS_CHECK(!v_depths_in, "v_depths needs gradients in columns");
      check_in_place("v_splats[0]", v_splats[0], ScalarType::Float, {splats, kSplatGradient});
      BLITZGS_CHECK(
          reinterpret_cast<std::uintptr_t>(v_splats[0].const_data_ptr()) % alignof(SplatGradient) == 0,
          "the table of v_splats must begin at a multiple of 16 bytes");
      return;
    }
    BLITZGS_CHECK(v_splats.size() == 3 || v_splats.size() == 4,
                  "v_splats must be v_means2d, v_conics, v_opacities[, v_colors] or one table, got ",
                  v_splats.size(), " tensors");
    v_splats[0] = checked("v_means2d", v_splats[0], dtype, {splats, 2});
    v_splats[1] = checked("v_conics", v_splats[1], dtype, {splats, 3});
    v_splats[2] = checked("v_opacities", v_splats[2], dtype, {splats});
    if (v_splats.size() == 4) v_splats[3] = checked("v_colors", v_splats[3], dtype, {splats, 3});
    v_depths = checked("v_depths", v_depths_in, dtype, {splats});
  }

  bool in_table() const { return v_splats.size() == 1; }
  int64_t visible() const { return visible_ids.numel(); }
  SplatIndex pointers() const { return {camera_ids, visible_ids, splat_offsets, visible()}; }
  template <class T> Regularisers<T> regularisers() const {
    return {data_or_null<T>(scale_reg), data_or_null<T>(opacity_reg)};
  }
  template <class T> SplatGradientSource<T> gradients() const {
#ifdef BLITZGS_BACKEND_CUDA
    if (in_table())
      return PackedSplatGradients{reinterpret_cast<const SplatGradient*>(data<float>(v_splats[0]))};
#endif
    return SplatGradientColumns<T>{data<T>(v_splats[0]), data<T>(v_splats[1]), data_or_null<T>(v_depths),
                                   data<T>(v_splats[2]),
                                   v_splats.size() == 4 ? data<T>(v_splats[3]) : nullptr};
  }
};

Tensors<6> project_bwd(const TensorList& gaussians, const Tensor& viewmats, const Tensor& Ks,
                       const OptionalTensor& scale_reg, const OptionalTensor& opacity_reg,
                       const Tensor& camera_ids, const Tensor& visible_ids, const Tensor& splat_offsets,
                       const OptionalTensor& level, BLITZGS_PROJECT_OPTIONS, const FloatList& fade,
                       const TensorList& v_splats, const OptionalTensor& v_depths, bool need_viewmats,
                       bool dense) {
  const ProjectArguments p(gaussians, viewmats, Ks, checked_options(BLITZGS_PROJECT_OPTION_NAMES, fade), fade,
                           level);
  const BackwardInputs b(p, camera_ids, visible_ids, splat_offsets, scale_reg, opacity_reg, v_splats,
                         v_depths);
  const int64_t length = dense ? p.count : b.visible();
  DeviceScope scope(p.means);
  return dispatch_floating(p.means, [&]<class T>() -> Tensors<6> {
    const auto v_means = make<T>(p.means, {length, 3}), v_quats = make<T>(p.means, {length, 4}),
               v_scales = make<T>(p.means, {length, 3}), v_opacities = make<T>(p.means, {length}),
               v_sh = make<T>(p.means, {length, p.sh_stride, 3}),
               v_viewmats = make<T>(p.means, {need_viewmats ? p.n_views : 0, 4, 4});
    if (dense) {
      backend::zero_arrays(
          ZeroedArrays<T>{{v_means, v_quats, v_scales, v_opacities, v_sh},
                          {3 * length, 4 * length, 3 * length, length, 3 * p.sh_stride * length}},
          scope.stream);
    }
    backend::project_bwd(
        p.inputs<T>(), b.pointers(), b.gradients<T>(), b.regularisers<T>(),
        ProjectGradients<T>{v_means, v_quats, v_scales, v_opacities, v_sh.data_if(p.sh.has_value()),
                            v_viewmats.data_if(need_viewmats), dense},
        scope.workspace, scope.stream);
    return {v_means, v_quats, v_scales, v_opacities, v_sh, v_viewmats};
  });
}

void project_bwd_step(const TensorList& state_in, const TensorList& tables, int64_t step,
                      int64_t explicit_steps, double beta1, double beta2, double eps, const Tensor& viewmats,
                      const Tensor& Ks, const OptionalTensor& scale_reg, const OptionalTensor& opacity_reg,
                      const Tensor& camera_ids, const Tensor& visible_ids, const Tensor& splat_offsets,
                      const OptionalTensor& level, BLITZGS_PROJECT_OPTIONS, const FloatList& fade,
                      const TensorList& v_splats) {
  AdamTensors state(state_in, tables, {step, explicit_steps, beta1, beta2, eps});
  state.check_takes_step();
  const ProjectArguments p(state.params, viewmats, Ks, checked_options(BLITZGS_PROJECT_OPTION_NAMES, fade),
                           fade, level);
  const BackwardInputs b(p, camera_ids, visible_ids, splat_offsets, scale_reg, opacity_reg, v_splats);
  if (b.visible() == 0) return;
  DeviceScope scope(p.means);
  dispatch_floating(p.means, [&]<class T>() {
    backend::project_bwd_step(p.inputs<T>(), b.pointers(), b.gradients<T>(), b.regularisers<T>(),
                              state.arguments<T>(b.visible_ids), scope.workspace, scope.stream);
  });
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "project_fwd", project_fwd);
  BLITZGS_OP(m, "project_bwd", project_bwd);
  BLITZGS_OP(m, "project_bwd_step_", project_bwd_step);
}
