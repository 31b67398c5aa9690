// SPDX-License-Identifier: Apache-2.0
#include "rasterize/rasterize.h"
#include "rasterize/tile_jobs.h"

namespace blitzgs::cpu {
namespace {

// The number of partial gradients (one per splat and tile) in memory at a time: a few megabytes, so that they
// are still in the cache when they are summed.
constexpr int64_t kPartialsPerChunk = 1 << 17;

template <class T> void clear_unowned(const RasterizeInput<T>& in, const RasterizeOutput<T>& out) {
  const TileGrid& grid = in.grid;
  if (grid.tile_begin == 0 && grid.tile_end == grid.count()) return;
  const int64_t pixels = int64_t(grid.n_cameras) * grid.height * grid.width;
  std::fill_n(out.renders, pixels * in.n_channels, T(0));
  std::fill_n(out.transmittances, pixels, T(0));
  std::fill_n(out.last_ids, pixels, 0);
  std::fill_n(out.tile_work, grid.count(), 0);
}

// Writes to used [owned tiles] the length of each owned tile's list up to its last composited entry.
template <class T>
void find_used_entries(const RasterizeInput<T>& in, const int32_t* last_ids, int32_t* used) {
  parallel_rows(in.grid.tile_end - in.grid.tile_begin, 8, [&](int64_t owned) {
    const TileJob<T> job = make_job<T>(in, nullptr, in.grid.tile_begin + owned);
    int32_t most = 0;
    for (int row = 0; row < job.height; ++row) {
      const int32_t* last = last_ids + job.first_pixel + int64_t(row) * job.image_width;
      for (int x = 0; x < job.width; ++x) most = std::max(most, last[x]);
    }
    used[owned] = most;
  });
}

// The owned tiles [begin, end) whose partial gradients are in memory together, and their number.
struct Chunk {
  int64_t begin, end;
  int64_t partials;
};

// Divides the owned tiles into chunks and writes to places [owned tiles] the position of each tile's partial
// gradients in the memory of its chunk.
std::vector<Chunk> cut_chunks(const TileGrid& grid, const int32_t* used, int64_t* places) {
  std::vector<Chunk> chunks;
  for (int64_t tile = grid.tile_begin; tile < grid.tile_end; ++tile) {
    const int64_t length = used[tile - grid.tile_begin];
    if (chunks.empty() || chunks.back().partials + length > kPartialsPerChunk) {
      chunks.push_back({tile, tile, 0});
    }
    places[tile - grid.tile_begin] = chunks.back().partials;
    chunks.back().partials += length;
    chunks.back().end = tile + 1;
  }
  return chunks;
}

// Adds the partial gradients of a chunk to the sums [P, width]. One thread adds all those of a splat, in the
// order of the tiles.
template <class T>
void add_partials(const RasterizeInput<T>& in, const Chunk& chunk, const int32_t* used, const T* partials,
                  int width, T* sums) {
  parallel_for(0, in.n_splats, 1 << 12, [&](int64_t begin, int64_t end) {
    const T* partial = partials;
    for (int64_t tile = chunk.begin; tile < chunk.end; ++tile) {
      const int32_t* list = in.isect_splats + in.tile_offsets[tile];
      const int32_t length = used[tile - in.grid.tile_begin];
      for (int32_t entry = 0; entry < length; ++entry, partial += width) {
        __builtin_prefetch(sums + int64_t(list[std::min(entry + 8, length - 1)]) * width);
        const int64_t splat = list[entry];
        if (splat < begin || splat >= end) continue;
        T* sum = sums + splat * width;
        for (int i = 0; i < width; ++i) sum[i] += partial[i];
      }
    }
  });
}

template <class T>
void write_gradients(const RasterizeInput<T>& in, const T* sums, int width,
                     const RasterizeGradients<T>& gradients) {
  parallel_rows(in.n_splats, 1 << 12, [&](int64_t splat) {
    const T* sum = sums + splat * width;
    std::copy_n(sum + kMeanX, 2, gradients.v_means2d + 2 * splat);
    std::copy_n(sum + kConicA, 3, gradients.v_conics + 3 * splat);
    gradients.v_opacities[splat] = sum[kOpacity];
    std::copy_n(sum + kColor, in.n_channels, gradients.v_colors + splat * in.n_channels);
    if (gradients.v_means2d_abs) {
      std::copy_n(sum + kColor + in.n_channels, 2, gradients.v_means2d_abs + 2 * splat);
    }
  });
}

}  // namespace

// Memory for prepared splats in float32. In float64, for checks, the backward pass prepares them again.
int64_t rasterize_splat_bytes(int) { return sizeof(PreparedSplat<float>); }

bool rasterize_orders_tiles(const TileGrid&) { return false; }

template <class T>
void rasterize_fwd(const RasterizeInput<T>& in, const RasterizeOutput<T>& out, const RasterizeAux& aux,
                   Workspace& workspace, CudaStream) {
  if (out.clear_rest) clear_unowned(in, out);
  const PreparedSplat<T>* splats =
      pack_splats(in, sizeof(T) == 4 ? static_cast<PreparedSplat<T>*>(aux.packed)
                                     : allocate_splats<T>(in.n_splats, workspace));
  const TileKernels<T> kernels = tile_kernels<T>(in.n_channels, false);
  const TileMemory<T> memory(in, workspace);
  parallel_tasks(in.grid.tile_end - in.grid.tile_begin, [&](int64_t task, int worker) {
    const int64_t tile = in.grid.tile_begin + task;
    TileJob<T> job = make_job(in, splats, tile);
    job.out = out;
    memory.lend(worker, &job);
    out.tile_work[tile] = kernels.forward(job);
  });
}

template <class T>
void rasterize_bwd(const RasterizeInput<T>& in, const RasterizeSaved<T>& saved, int64_t,
                   const RasterizeAux& aux, bool, const RasterizeGradients<T>& gradients,
                   Workspace& workspace, CudaStream) {
  const bool absgrad = gradients.v_means2d_abs != nullptr;
  const int width = partial_width(in.n_channels, absgrad);
  const int64_t n_owned = in.grid.tile_end - in.grid.tile_begin;
  auto* used = workspace.allocate<int32_t>(n_owned);
  auto* places = workspace.allocate<int64_t>(n_owned);
  find_used_entries(in, saved.last_ids, used);
  const std::vector<Chunk> chunks = cut_chunks(in.grid, used, places);
  int64_t most = 0;
  for (const Chunk& chunk : chunks) most = std::max(most, chunk.partials);
  auto* partials = workspace.allocate<T>(most * width);
  auto* sums = workspace.allocate<T>(in.n_splats * width);
  parallel_zero(sums, in.n_splats * width);
  const PreparedSplat<T>* splats = sizeof(T) == 4
                                       ? static_cast<const PreparedSplat<T>*>(aux.packed)
                                       : pack_splats(in, allocate_splats<T>(in.n_splats, workspace));
  const TileKernels<T> kernels = tile_kernels<T>(in.n_channels, absgrad);
  const TileMemory<T> memory(in, workspace);
  for (const Chunk& chunk : chunks) {
    parallel_tasks(chunk.end - chunk.begin, [&](int64_t task, int worker) {
      const int64_t tile = chunk.begin + task, owned = tile - in.grid.tile_begin;
      if (used[owned] == 0) return;
      TileJob<T> job = make_job(in, splats, tile);
      job.n_entries = used[owned];
      job.saved = saved;
      memory.lend(worker, &job);
      kernels.backward(job, partials + places[owned] * width);
    });
    add_partials(in, chunk, used, partials, width, sums);
  }
  write_gradients(in, sums, width, gradients);
}

template <class T>
void pixel_splats(const RasterizeInput<T>& in, const PixelSplats<T>& out, Workspace& workspace, CudaStream) {
  for_each_colorless_tile(in, workspace, [&](const TileKernels<T>& kernels, const TileJob<T>& tile) {
    kernels.list_splats(tile, out);
  });
}

BLITZGS_FOR_BOTH_DTYPES(rasterize_fwd);
BLITZGS_FOR_BOTH_DTYPES(rasterize_bwd);
BLITZGS_FOR_BOTH_DTYPES(pixel_splats);

}  // namespace blitzgs::cpu
