// SPDX-License-Identifier: Apache-2.0
// The code that calls the CPU tile kernels: it prepares the splats and describes the tiles as jobs.
#pragma once
#include "common/parallel.h"
#include "rasterize/rasterize.h"
#include "rasterize/tile_kernels.h"

namespace blitzgs::cpu {
namespace {

template <class T> TileKernels<T> tile_kernels(int n_channels, bool absgrad) {
  if constexpr (std::is_same_v<T, float>) {
    if (use_avx2()) return avx2_tile_kernels(n_channels, absgrad);
  }
  return select_kernels<PlainLanes<T>>(n_channels, absgrad);
}

template <class T> PreparedSplat<T> pack_splat(const RasterizeInput<T>& in, int64_t index) {
  constexpr T kScale = kExponentScale<T>;
  constexpr T kRounding = sizeof(T) == 4 ? T(2e-6) : T(2e-14);
  PreparedSplat<T> splat{};
  SplatEllipse<T> e;
  splat.x = in.means2d[2 * index];
  splat.y = in.means2d[2 * index + 1];
  splat.half_height = T(-1);
  splat.cut = T(-1);
  splat.opacity = T(1);
  if (!is_finite(splat.x) || !is_finite(splat.y)) return splat;
  if (!make_ellipse(in.conics + 3 * index, in.opacities[index], &e)) return splat;
  const ConicFactor<T> factor = factor_conic(in.conics + 3 * index);
  const T root = std::sqrt(kScale);
  splat.l11 = factor.l11 * root;
  splat.l21 = factor.l21 * root;
  splat.l22 = factor.l22 * root;
  splat.opacity = in.opacities[index];
  splat.cut = e.cut * kScale;
  splat.inv_l11 = T(1) / splat.l11;
  splat.shear = e.shear;
  splat.half_height = e.half_height + kRounding * std::fabs(splat.y);
  const T height = T(in.grid.height);
  splat.slack = kRounding * (std::fabs(splat.x) + std::fabs(e.shear) * (std::fabs(splat.y) + height) +
                             std::sqrt(splat.cut) * splat.inv_l11);
  for (int c = 0; c < std::min(in.n_channels, kPackedChannels); ++c) {
    splat.color[c] = in.colors[index * in.n_channels + c];
  }
  return splat;
}

template <class T>
const PreparedSplat<T>* pack_splats(const RasterizeInput<T>& in, PreparedSplat<T>* splats) {
  parallel_rows(in.n_splats, 1 << 12, [&](int64_t index) { splats[index] = pack_splat(in, index); });
  return splats;
}

template <class T> PreparedSplat<T>* allocate_splats(int64_t n_splats, Workspace& workspace) {
  const size_t bytes = size_t(n_splats + 1) * sizeof(PreparedSplat<T>);
  const auto address = reinterpret_cast<std::uintptr_t>(workspace.allocate_bytes(bytes));
  return reinterpret_cast<PreparedSplat<T>*>((address + 63) / 64 * 64);
}

// A job with the tile's position in the images and its list. The caller sets the outputs and the memory.
template <class T>
TileJob<T> make_job(const RasterizeInput<T>& in, const PreparedSplat<T>* splats, int64_t tile) {
  const TileGrid& grid = in.grid;
  const int64_t camera = tile / grid.per_image(), within = tile % grid.per_image();
  TileJob<T> job{};
  job.splats = splats;
  job.colors = in.colors;
  job.background = in.backgrounds ? in.backgrounds + camera * in.n_channels : nullptr;
  job.list = in.isect_splats + in.tile_offsets[tile];
  job.n_entries = int32_t(in.tile_offsets[tile + 1] - in.tile_offsets[tile]);
  job.n_channels = in.n_channels;
  job.tile_size = grid.tile_size;
  job.x0 = int(within % grid.tiles_x) * grid.tile_size;
  job.y0 = int(within / grid.tiles_x) * grid.tile_size;
  job.width = std::min(grid.tile_size, grid.width - job.x0);
  job.height = std::min(grid.tile_size, grid.height - job.y0);
  job.image_width = grid.width;
  job.first_pixel = (camera * grid.height + job.y0) * grid.width + job.x0;
  return job;
}

// Scratch memory for the pixels of one tile per worker thread.
template <class T> class TileMemory {
 public:
  TileMemory(const RasterizeInput<T>& in, Workspace& workspace)
      : numbers_(tile_memory(in.grid.tile_size, in.n_channels)),
        integers_(PlaneLayout(in.grid.tile_size).plane),
        memory_(workspace.allocate<T>(int64_t(numbers_) * num_threads())),
        last_(workspace.allocate<int32_t>(int64_t(integers_) * num_threads())) {}

  void lend(int worker, TileJob<T>* job) const {
    job->memory = memory_ + worker * numbers_;
    job->last_memory = last_ + worker * integers_;
  }

 private:
  size_t numbers_, integers_;
  T* memory_;
  int32_t* last_;
};

// Calls f(kernels, job) for each owned tile without colours, on all threads.
template <class T, class F>
void for_each_colorless_tile(const RasterizeInput<T>& in, Workspace& workspace, const F& f) {
  const PreparedSplat<T>* splats = pack_splats(in, allocate_splats<T>(in.n_splats, workspace));
  const TileKernels<T> kernels = tile_kernels<T>(0, false);
  const TileMemory<T> memory(in, workspace);
  parallel_tasks(in.grid.tile_end - in.grid.tile_begin, [&](int64_t task, int worker) {
    TileJob<T> job = make_job(in, splats, in.grid.tile_begin + task);
    memory.lend(worker, &job);
    f(kernels, job);
  });
}

}  // namespace
}  // namespace blitzgs::cpu
