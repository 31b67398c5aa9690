// SPDX-License-Identifier: Apache-2.0
// The two ops of which list_and_rasterize consists; csrc/registration.cpp has their arguments.
#pragma once
#include <optional>
#include <tuple>
#include <vector>

#include "common/op.h"

namespace blitzgs {

std::tuple<Tensor, Tensor> intersect(const Tensor& means2d, const Tensor& conics,
                                     const Tensor& splat_opacities, const Tensor& depths,
                                     const Tensor& camera_ids, const std::optional<Tensor>& ids,
                                     const std::vector<std::int64_t>& grid_numbers, std::int64_t n_isects,
                                     const std::optional<Tensor>& known_splats, bool unchecked);

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> rasterize_fwd(
    const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities, const Tensor& colors,
    const std::optional<Tensor>& backgrounds, const Tensor& isect_splats, const Tensor& tile_offsets,
    const std::vector<std::int64_t>& grid_numbers, const std::optional<Tensor>& means2d_abs, bool clear_rest,
    bool backward_follows, const std::optional<Tensor>& known_splats);

}  // namespace blitzgs
