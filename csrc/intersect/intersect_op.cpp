// SPDX-License-Identifier: Apache-2.0
#include "intersect/intersect.h"

#include <exception>

#include "rasterize/rasterize_op.h"

namespace blitzgs {
namespace {

void check_capacity(int64_t capacity, int64_t count) {
  BLITZGS_CHECK(count <= capacity, "n_isects is ", capacity, " but there are ", count,
                " intersections; pass the sum of tiles_touched, or -1 to have them counted");
}

}  // namespace

Tensors<2> intersect(const Tensor& means2d, const Tensor& conics, const Tensor& splat_opacities,
                     const Tensor& depths, const Tensor& camera_ids, const OptionalTensor& ids, BLITZGS_TILES,
                     int64_t n_isects, const OptionalTensor& known_splats, bool unchecked) {
  check_floating("means2d", means2d);
  const int64_t n_splats = means2d.size(0);
  const auto cameras = checked<int32_t>("camera_ids", camera_ids, {n_splats});
  const auto id_splats = checked<int64_t>("ids", ids, {n_splats});
  const auto [valid_splats, known] = checked_splat_count(known_splats, means2d);
  const TileGrid grid = checked_tile_grid(n_cameras, width, height, tile_size, tile_begin, tile_end);
  BLITZGS_CHECK(grid.count() <= INT32_MAX, "tile numbers are 32-bit, got ", grid.count(),
                " tiles; use larger tiles or render fewer views at once");
  DeviceScope scope(means2d);
  return dispatch_floating(means2d, [&]<class T>() -> Tensors<2> {
    const auto means = checked<T>("means2d", means2d, {n_splats, 2}),
               shapes = checked<T>("conics", conics, {n_splats, 3}),
               opacities = checked<T>("splat_opacities", splat_opacities, {n_splats}),
               order = checked<T>("depths", depths, {n_splats});
    const IntersectInput<T> in{means,     shapes,       opacities, order, cameras,
                               id_splats, valid_splats, grid,      known};
    int64_t capacity = n_isects;
    // On CUDA backend::intersect does not return the number, so the op counts first and waits for the count.
    if (n_isects < 0 || (kOnCuda && !unchecked)) {
      const int64_t needed = backend::count_intersections(in, scope.workspace, scope.stream);
      if (n_isects < 0) capacity = needed;
      check_capacity(capacity, needed);
    }
    const auto offsets = make<int64_t>(means, {grid.count() + 1});
    Tensor splats;
    int64_t count = 0;
    try {
      splats = make<int32_t>(means, {capacity});
      count = backend::intersect(in, capacity, mutable_data<int32_t>(splats), offsets, scope.workspace,
                                 scope.stream);
    } catch (const std::exception& error) {
      // An error here means that memory ran out. The message states the length of the lists, because it
      // depends on the splats and the caller may not know it.
      BLITZGS_CHECK(false, "listing ", capacity, " intersections of ", n_splats,
                    " splats failed; it takes about ", capacity * 20 / 1000000, " MB. Render fewer views at ",
                    "once, in smaller images, or with a larger radius_clip. Cause: ", error.what());
    }
    check_capacity(capacity, count);
    return {splats, offsets};
  });
}

}  // namespace blitzgs

BLITZGS_REGISTER(m) { BLITZGS_OP(m, "intersect", intersect); }
