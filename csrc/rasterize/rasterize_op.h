// SPDX-License-Identifier: Apache-2.0
// What the ops that composite splats share: the checked splats, and the ops that others call.
#pragma once
#include "common/op.h"
#include "rasterize/rasterize.h"

namespace blitzgs {

// The geometry of P splats and the tiles' lists, checked and contiguous. The object holds the tensors, so
// that the raw pointers stay valid.
struct ListedSplats {
  ListedSplats(const Tensor& means2d_in, const Tensor& conics_in, const Tensor& opacities_in,
               const Tensor& isect_splats_in, const Tensor& tile_offsets_in, const TileGrid& grid_in,
               const OptionalTensor& known_splats = std::nullopt)
      : grid(grid_in),
        n_splats(means2d_in.size(0)),
        splat_count(checked_splat_count(known_splats, means2d_in)) {
    check_floating("means2d", means2d_in);
    const ScalarType dtype = means2d_in.scalar_type();
    means2d = checked("means2d", means2d_in, dtype, {n_splats, 2});
    conics = checked("conics", conics_in, dtype, {n_splats, 3});
    opacities = checked("splat_opacities", opacities_in, dtype, {n_splats});
    isect_splats = checked("isect_splats", isect_splats_in, ScalarType::Int, {-1});
    tile_offsets = checked("tile_offsets", tile_offsets_in, ScalarType::Long, {grid.count() + 1});
    if (tile_offsets.is_cpu()) check_lists();  // on CUDA the host would wait for the values
  }

  // The colours [P, D] to composite, before backgrounds [B, D] or black.
  void set_colors(const Tensor& colors_in, const OptionalTensor& backgrounds_in) {
    const ScalarType dtype = means2d.scalar_type();
    colors = checked("colors", colors_in, dtype, {n_splats, -1});
    n_channels = colors->size(1);
    BLITZGS_CHECK(n_channels > 0 && n_channels <= 4096, "colors must have 1 to 4096 channels, got ",
                  n_channels);
    backgrounds = checked("backgrounds", backgrounds_in, dtype, {grid.n_cameras, n_channels});
  }

  template <class T> RasterizeInput<T> input() const {
    return {data<T>(means2d),
            data<T>(conics),
            data<T>(opacities),
            data_or_null<T>(colors),
            data_or_null<T>(backgrounds),
            data<int32_t>(isect_splats),
            data<int64_t>(tile_offsets),
            splat_count.n_splats,
            int(n_channels),
            grid,
            splat_count.known_splats};
  }

  // Lists of another call, or of other splats, would lead the kernels out of the tensors.
  void check_lists() const {
    const auto* const offsets = data<int64_t>(tile_offsets);
    const auto* const list = data<int32_t>(isect_splats);
    const int64_t tiles = grid.count(), entries = isect_splats.size(0);
    BLITZGS_CHECK(
        offsets[0] >= 0 && offsets[tiles] <= entries && std::is_sorted(offsets, offsets + tiles + 1),
        "tile_offsets must ascend from 0 to at most the ", entries, " entries of isect_splats");
    uint32_t largest = 0;  // a negative number becomes a large one
    for (int64_t i = offsets[0]; i < offsets[tiles]; ++i) largest = std::max(largest, uint32_t(list[i]));
    BLITZGS_CHECK(offsets[tiles] == offsets[0] || largest < n_splats, "isect_splats must be numbers of the ",
                  n_splats, " splats");
  }

  TileGrid grid;
  int64_t n_splats, n_channels = 0;  // n_splats: the length of the columns
  SplatCount splat_count;
  Tensor means2d, conics, opacities, isect_splats, tile_offsets;
  OptionalTensor colors, backgrounds;
};

Tensors<2> intersect(const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities,
                     const Tensor& depths, const Tensor& camera_ids, const OptionalTensor& ids, BLITZGS_TILES,
                     int64_t n_isects, const OptionalTensor& known_splats, bool unchecked);

Tensors<7> rasterize_fwd(const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities,
                         const Tensor& colors, const OptionalTensor& backgrounds, const Tensor& isect_splats,
                         const Tensor& tile_offsets, BLITZGS_TILES, bool clear_rest, bool backward_follows,
                         const OptionalTensor& known_splats);

}  // namespace blitzgs
