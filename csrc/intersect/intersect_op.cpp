// SPDX-License-Identifier: Apache-2.0
#include "intersect/intersect.h"

#include <exception>
#include <tuple>

#include "rasterize/rasterize_op.h"

namespace blitzgs {
namespace {

// Whether backend::intersect does not return the number of intersections, so that the op has to count them
// first and wait for the count.
#ifdef BLITZGS_BACKEND_CUDA
constexpr bool kWaitsForCounts = true;
#else
constexpr bool kWaitsForCounts = false;
#endif

void check_capacity(std::int64_t capacity, std::int64_t count) {
  BLITZGS_CHECK(count <= capacity, "intersect", "n_isects is ", capacity, " but there are ", count,
                " intersections; pass the sum of tiles_touched, or -1 to have them counted");
}

}  // namespace

std::tuple<Tensor, Tensor> intersect(const Tensor& means2d, const Tensor& conics,
                                     const Tensor& splat_opacities, const Tensor& depths,
                                     const Tensor& camera_ids, const std::optional<Tensor>& ids,
                                     std::int64_t n_cameras, std::int64_t width, std::int64_t height,
                                     std::int64_t tile_size, std::int64_t tile_begin, std::int64_t tile_end,
                                     std::int64_t n_isects, const std::optional<Tensor>& known_splats,
                                     bool unchecked) {
  constexpr const char* kOp = "intersect";
  check_floating(kOp, "means2d", means2d);
  const std::int64_t n_splats = means2d.size(0);
  const auto cameras = checked<std::int32_t>(kOp, "camera_ids", camera_ids, {n_splats});
  const auto id_splats = checked<std::int64_t>(kOp, "ids", ids, {n_splats});
  const SplatCount splat_count = checked_splat_count(kOp, known_splats, means2d);
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  BLITZGS_CHECK(grid.count() <= std::numeric_limits<std::int32_t>::max(), kOp,
                "tile numbers are 32-bit, got ", grid.count(),
                " tiles; use larger tiles or render fewer views at once");
  DeviceScope scope(means2d);
  return dispatch_floating(means2d, [&]<class T>() -> std::tuple<Tensor, Tensor> {
    const auto means = checked<T>(kOp, "means2d", means2d, {n_splats, 2}),
               shapes = checked<T>(kOp, "conics", conics, {n_splats, 3}),
               opacities = checked<T>(kOp, "splat_opacities", splat_opacities, {n_splats}),
               order = checked<T>(kOp, "depths", depths, {n_splats});
    const IntersectInput<T> in{means,
                               shapes,
                               opacities,
                               order,
                               cameras,
                               id_splats,
                               splat_count.n_splats,
                               grid,
                               splat_count.known_splats};
    std::int64_t capacity = n_isects;
    if (n_isects < 0 || (kWaitsForCounts && !unchecked)) {
      const std::int64_t needed = backend::count_intersections(in, scope.workspace, scope.stream);
      if (n_isects < 0) capacity = needed;
      check_capacity(capacity, needed);
    }
    const auto offsets = make<std::int64_t>(means, {grid.count() + 1});
    Tensor splats;
    std::int64_t count = 0;
    try {
      splats = make<std::int32_t>(means, {capacity});
      count = backend::intersect(in, capacity, mutable_data<std::int32_t>(splats), offsets, scope.workspace,
                                 scope.stream);
    } catch (const std::exception& error) {
      // An error here means that memory ran out. The message states the length of the lists, because it
      // depends on the splats and the caller may not know it.
      BLITZGS_CHECK(false, kOp, "listing ", capacity, " intersections of ", n_splats,
                    " splats failed; it takes about ", capacity * 20 / 1000000, " MB. Render fewer views at ",
                    "once, in smaller images, or with a larger radius_clip. Cause: ", error.what());
    }
    check_capacity(capacity, count);
    return {splats, offsets};
  });
}

}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("intersect", TORCH_BOX(&blitzgs::intersect)); }
