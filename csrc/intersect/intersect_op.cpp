// SPDX-License-Identifier: Apache-2.0
#include "intersect/intersect.h"

#include <exception>
#include <limits>
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
  const ScalarType dtype = means2d.scalar_type();
  const Tensor means = checked(kOp, "means2d", means2d, dtype, {n_splats, 2}),
               shapes = checked(kOp, "conics", conics, dtype, {n_splats, 3}),
               opacities = checked(kOp, "splat_opacities", splat_opacities, dtype, {n_splats}),
               order = checked(kOp, "depths", depths, dtype, {n_splats}),
               cameras = checked(kOp, "camera_ids", camera_ids, ScalarType::Int, {n_splats});
  const std::optional<Tensor> id_splats = checked(kOp, "ids", ids, ScalarType::Long, {n_splats});
  const SplatCount splat_count = checked_splat_count(kOp, known_splats, means2d);
  const TileGrid grid = checked_tile_grid(kOp, n_cameras, width, height, tile_size, tile_begin, tile_end);
  BLITZGS_CHECK(grid.count() <= std::numeric_limits<std::int32_t>::max(), "intersect",
                "tile numbers are 32-bit, got ", grid.count(),
                " tiles; use larger tiles or render fewer views at once");
  Tensor offsets = make_empty(means, {grid.count() + 1}, ScalarType::Long);
  Tensor splats;
  DeviceScope scope(means);
  dispatch_floating(means, [&]<class T>() {
    const IntersectInput<T> in{data<T>(means),
                               data<T>(shapes),
                               data<T>(opacities),
                               data<T>(order),
                               data<std::int32_t>(cameras),
                               data_or_null<std::int64_t>(id_splats),
                               splat_count.n_splats,
                               grid,
                               splat_count.known_splats};
    std::int64_t capacity = n_isects;
    if (n_isects < 0 || (kWaitsForCounts && !unchecked)) {
      const std::int64_t needed = backend::count_intersections(in, scope.workspace, scope.stream);
      if (n_isects < 0) capacity = needed;
      check_capacity(capacity, needed);
    }
    std::int64_t count = 0;
    try {
      splats = make_empty(means, {capacity}, ScalarType::Int);
      count = backend::intersect(in, capacity, mutable_data<std::int32_t>(splats),
                                 mutable_data<std::int64_t>(offsets), scope.workspace, scope.stream);
    } catch (const std::exception& error) {
      // An error here means that memory ran out. The message states the length of the lists, because it
      // depends on the splats and the caller may not know it.
      BLITZGS_CHECK(false, "intersect", "listing ", capacity, " intersections of ", n_splats,
                    " splats failed; it takes about ", capacity * 20 / 1000000, " MB. Render fewer views at ",
                    "once, in smaller images, or with a larger radius_clip. Cause: ", error.what());
    }
    check_capacity(capacity, count);
  });
  return {splats, offsets};
}

}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("intersect", TORCH_BOX(&blitzgs::intersect)); }
