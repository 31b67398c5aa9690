// SPDX-License-Identifier: Apache-2.0
// intersect, rasterize_fwd and alphas in one op, because each call of an op takes the host microseconds.
#include "render/list_and_rasterize.h"

#include <optional>
#include <tuple>
#include <vector>

#include "common/op.h"

namespace blitzgs {

// Defined in intersect_op.cpp and rasterize_op.cpp.
std::tuple<Tensor, Tensor> intersect(const Tensor& means2d, const Tensor& conics,
                                     const Tensor& splat_opacities, const Tensor& depths,
                                     const Tensor& camera_ids, const std::optional<Tensor>& ids,
                                     const std::vector<std::int64_t>& grid_numbers, std::int64_t n_isects,
                                     const std::optional<Tensor>& known_splats, bool unchecked);
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_splats, const Tensor& tile_offsets,
    const std::vector<std::int64_t>& grid_numbers, bool clear_rest, bool backward_follows,
    const std::optional<Tensor>& known_splats);

namespace {

std::vector<Tensor> list_and_rasterize(const std::vector<Tensor>& splats, const Tensor& depths,
                                       const Tensor& camera_ids, const std::optional<Tensor>& backgrounds,
                                       const std::vector<std::int64_t>& grid, std::int64_t n_isects,
                                       bool backward_follows, const std::optional<Tensor>& n_splats) {
  STD_TORCH_CHECK(
      splats.size() == 4,
      "blitzgs::list_and_rasterize: splats must be (means2d, conics, splat_opacities, colors), got ",
      splats.size(), " tensors");
  const auto lists = intersect(splats[0], splats[1], splats[2], depths, camera_ids, std::nullopt, grid,
                               n_isects, n_splats, /*unchecked=*/true);
  const auto outputs =
      rasterize_fwd(splats[0], splats[1], splats[2], splats[3], backgrounds, std::get<0>(lists),
                    std::get<1>(lists), grid, /*clear_rest=*/true, backward_follows, n_splats);
  const Tensor& transmittances = std::get<1>(outputs);
  Tensor alphas =
      make_empty(transmittances, {transmittances.size(0), transmittances.size(1), transmittances.size(2)});
  DeviceScope scope(alphas);
  dispatch_floating(alphas, [&](auto zero) {
    using T = decltype(zero);
    backend::alphas_of(data<T>(transmittances), alphas.numel(), mutable_data<T>(alphas), scope.stream);
  });
  return std::apply([&](const auto&... tensors) { return std::vector<Tensor>{tensors..., alphas}; },
                    std::tuple_cat(lists, outputs));
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("list_and_rasterize", TORCH_BOX(&blitzgs::list_and_rasterize)); }
