// SPDX-License-Identifier: Apache-2.0
// Compiled without FMA contraction (cmake/cuda.cmake): counting and emitting project the same row in two
// kernels, and must get the same bits.
#include <algorithm>
#include <iterator>
#include <type_traits>

#include "peers/peers.h"
#include "project/project_plan.cuh"
#include "scatter/scatter_device.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kListThreads = 256;
constexpr int kEmitThreads = 128, kEmitBlocks = 5;

// Which Gaussian and view each row is of. A warp takes a segment.
__global__ void __launch_bounds__(kListThreads)
    list_rows_kernel(const Inputs in, const MadePlan plan, const ProjectRoom room, const ProjectIds out) {
  const int lane = threadIdx.x % 32;
  const std::int64_t s = (blockIdx.x * static_cast<std::int64_t>(kListThreads) + threadIdx.x) / 32;
  const std::int64_t candidates = candidates_of(in);
  const ProjectSizes sizes = fitting(room);
  // What emitting reads before it knows how many rows there are.
  for (std::int64_t i = sizes.rows + blockIdx.x * std::int64_t{kListThreads} + threadIdx.x;
       i < room.sizes.rows; i += gridDim.x * std::int64_t{kListThreads}) {
    out.gaussian_ids[i] = -1;
  }
  if (s == 0 && lane == 0) out.row_offsets[sizes.visible] = static_cast<std::int32_t>(sizes.rows);
  if (s >= segments_of(candidates) || sizes.rows == 0) return;
  const std::int64_t before = plan.before[s], first_candidate = s * segment_of(candidates);
  const auto count = static_cast<int>((plan.before[s + 1] >> 32) - (before >> 32));
  std::int64_t at = before & 0xffffffff;
  for (int first = 0; first < count; first += 32) {
    const bool present = first + lane < count;
    const std::uint32_t views = present ? plan.views[first_candidate + first + lane] : 0;
    int end = __popc(views);
    for (int step = 1; step < 32; step *= 2) {
      const int other = __shfl_up_sync(0xffffffffu, end, step);
      if (lane >= step) end += other;
    }
    const int begin = end - __popc(views), n_rows = __shfl_sync(0xffffffffu, end, 31);
    const std::int64_t u = (before >> 32) + first + lane;
    std::int32_t id = 0;
    if (present && u < sizes.visible) {
      id = static_cast<std::int32_t>(
          candidate_id(in, first_candidate + plan.slots[first_candidate + first + lane]));
      out.visible_ids[u] = id;
      out.row_offsets[u] = static_cast<std::int32_t>(at + begin);
    }
    // Lanes write consecutive rows: each finds the candidate whose `end` is the first beyond its row.
    for (int base = 0; base < n_rows; base += 32) {
      const int row = base + lane;
      int owner = 0;
#pragma unroll
      for (int step = 16; step > 0; step /= 2) {
        if (__shfl_sync(0xffffffffu, end, owner + step - 1) <= row) owner += step;
      }
      std::uint32_t rest = __shfl_sync(0xffffffffu, views, owner);
      const int owner_begin = __shfl_sync(0xffffffffu, begin, owner);
      const std::int32_t owner_id = __shfl_sync(0xffffffffu, id, owner);
      if (row >= n_rows || at + row >= sizes.rows) continue;
      for (int skip = row - owner_begin; skip > 0; --skip) rest &= rest - 1;
      out.gaussian_ids[at + row] = owner_id;
      out.camera_ids[at + row] = __ffs(rest) - 1;
    }
    at += n_rows;
  }
}

// Writes row i, of Gaussian id (-1: none); the whole warp takes part. sh_slot: where `stage` gathers its SH
// row.
template <int DEGREE, bool QUADS>
__device__ void emit_row(const Inputs& in, const RankTiles& rank_tiles, const ProjectIds& ids,
                         const ProjectOutputs<float>& out, const Camera<float>* cameras, TripleStage& triple,
                         ShStage<DEGREE>& stage, int sh_slot, std::int64_t i, std::int32_t id) {
  const int lane = threadIdx.x % 32;
  const int view = id < 0 ? 0 : ids.camera_ids[i];
  const Camera<float>& camera = cameras[view];
  const Vec3<float> mean = triple.gather(in.means, id, lane), scale = triple.gather(in.scales, id, lane);
  if (id >= 0) {
    const ActiveGaussian<float> gaussian = make_gaussian(in, id, mean, scale);
    Row<float> row{};
    project_row(camera, gaussian, in.options, &row);
    reinterpret_cast<float2*>(out.means2d)[i] = {row.mean2d[0], row.mean2d[1]};
    for (int k = 0; k < 3; ++k) out.conics[3 * i + k] = row.conic[k];
    out.depths[i] = row.depth;
    out.opacities[i] = row.opacity;
    reinterpret_cast<int2*>(out.radii)[i] = {pixel_radius(row.extent[0]), pixel_radius(row.extent[1])};
    std::int64_t ranks;
    out.tiles_touched[i] = row_tiles(row, view, in.options, rank_tiles, &ranks, [](int, std::int64_t) {});
    if (out.rank_masks) out.rank_masks[i] = ranks;
  }
  if (!in.sh) return;
  bool shown = true;
  if constexpr (QUADS) {
    stage.wait();
    if (id < 0) return;
    ShRow<DEGREE> sh;
    stage.read(sh_slot, &sh);
    shown = row_color(camera, mean, sh.values, DEGREE, out.colors + 3 * i);
  } else if (id >= 0) {
    shown = row_color(camera, mean, in.sh + 3 * in.options.sh_stride * std::int64_t{id}, DEGREE,
                      out.colors + 3 * i);
  }
  if (shown) return;
  out.opacities[i] = 0.f;
  reinterpret_cast<int2*>(out.radii)[i] = {0, 0};
  out.tiles_touched[i] = 0;
}

// Rows stay here, or go to other ranks as well: then a block writes kScatterBlock of them, and its stores to
// those ranks' memory go on beside the other blocks' projection.
struct StayHere {
  static constexpr int kRows = kEmitThreads;
};

// What this rank writes to the others, as its device works it out; sizes come first, as in project_totals.
struct Admitted {
  ProjectSizes sizes;
  std::int64_t rows[kMaxPeers], starts[kMaxPeers];
  std::int32_t split;  // rows of the first part
};
struct GoToRanks {
  static constexpr int kRows = kScatterBlock;
  const std::int64_t* ids;
  std::int64_t* row_ids;
  ScatterRows rows;
  ScatterTargets targets;
  const Admitted* admitted;
  ScatterState state;
  int n_ranks;
};

// One warp, a lane a rank. Rows that do not fit, here or at some rank, are not admitted.
__global__ void admit_kernel(const __grid_constant__ ProjectScatter scatter, int n_views, ProjectSizes room,
                             const std::int32_t* row_offsets, Admitted* out) {
  const int m = threadIdx.x, n_ranks = scatter.n_ranks;
  const std::int64_t stride = kTotalViews + n_views + 2 * n_ranks;
  const auto rows = [&](int source, int target) {
    return scatter.everyone[source * stride + kTotalViews + n_views + 2 * target];
  };
  std::int64_t sent = 0, received = 0, start = 0;
  if (m < n_ranks) {
    for (int other = 0; other < n_ranks; ++other) {
      if (other == scatter.rank) start = received;
      sent += rows(m, other);
      received += rows(other, m);
    }
    out->rows[m] = rows(scatter.rank, m);
    out->starts[m] = start;
    scatter.filled[m] = scatter.filled[n_ranks + m] = 0;
  }
  const bool admitted = __all_sync(0xffffffffu, sent <= scatter.capacity && received <= scatter.capacity);
  if (m > 0) return;
  const ProjectSizes sizes = fitting({room, scatter.everyone + scatter.rank * stride});
  out->sizes = admitted ? sizes : ProjectSizes{0, 0};
  out->split =
      row_offsets[static_cast<std::int64_t>(scatter.first_part * static_cast<double>(sizes.visible))];
}

// Apart, so that its registers are not added to those of the projection.
__device__ __noinline__ void send_block(ScatterShared<kMaxPeers>& shared, const GoToRanks& to,
                                        std::int64_t n_rows) {
  scatter_block<kEmitThreads>(shared, to.rows, n_rows, {to.admitted->rows, to.admitted->starts, to.n_ranks},
                              to.targets, to.state);
}

template <int DEGREE, bool QUADS, class DESTINATION>
__global__ void __launch_bounds__(kEmitThreads, kEmitBlocks)
    emit_kernel(const Inputs in, const RankTiles rank_tiles, const ProjectIds ids, const ProjectRoom room,
                const ProjectOutputs<float> out, const __grid_constant__ DESTINATION destination) {
  union Shared {
    ShStage<DEGREE> stages[QUADS ? kEmitThreads / 32 : 1];
    ScatterShared<kMaxPeers> scatter;
  };
  __shared__ Shared shared;
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ TripleStage triples[kEmitThreads / 32];
  const int warp = threadIdx.x / 32;
  ShStage<DEGREE>& stage = shared.stages[QUADS ? warp : 0];
  const std::int64_t begin = blockIdx.x * std::int64_t{DESTINATION::kRows};
  // Asked for together with the number of rows, whether or not there is this one.
  const std::int32_t asked =
      begin + threadIdx.x < room.sizes.rows ? ids.gaussian_ids[begin + threadIdx.x] : -1;
  const std::int64_t n_rows = fitting(room).rows;
  if (begin >= n_rows) return;
#pragma unroll 1
  for (int first = 0; first < DESTINATION::kRows; first += kEmitThreads) {
    const std::int64_t i = begin + first + threadIdx.x;
    const std::int32_t id = i >= n_rows ? -1 : first == 0 ? asked : ids.gaussian_ids[i];
    int sh_slot = 0;
    if constexpr (QUADS) sh_slot = stage.gather(in.sh, 3 * in.options.sh_stride, id, threadIdx.x % 32);
    if (first == 0) {
      load_cameras(in, cameras);
      __syncthreads();
    }
    emit_row<DEGREE, QUADS>(in, rank_tiles, ids, out, cameras, triples[warp], stage, sh_slot, i, id);
    if constexpr (std::is_same_v<DESTINATION, GoToRanks>) {
      if (id >= 0) destination.row_ids[i] = destination.ids[id];
    }
    __syncwarp();
  }
  if constexpr (std::is_same_v<DESTINATION, GoToRanks>) {
    __syncthreads();
    send_block(shared.scatter, destination, n_rows);
  }
}

template <class DESTINATION>
void emit_rows(const Inputs& in, const RankTiles& rank_tiles, const ProjectIds& ids, const ProjectRoom& room,
               const ProjectOutputs<float>& out, const DESTINATION& destination, CudaStream stream) {
  if (room.sizes.rows == 0) return;
  dispatch_sh(in, [&](auto degree, auto quads) {
    emit_kernel<degree.value, quads.value, DESTINATION>
        <<<blocks_for(room.sizes.rows, DESTINATION::kRows), kEmitThreads, 0, stream>>>(
            in, rank_tiles, ids, room, out, destination);
  });
  check_launch("project_emit");
}

}  // namespace

template <>
void project_list<float>(const Inputs& in, const void* plan_memory, const ProjectRoom& room,
                         const ProjectIds& ids, Workspace&, CudaStream stream) {
  if (room.sizes.rows == 0) {
    check(cudaMemsetAsync(ids.row_offsets, 0, sizeof(std::int32_t), stream), "project_emit");
    return;
  }
  const MadePlan plan(plan_memory, in.n_candidates);
  const std::int64_t segments = std::max<std::int64_t>(1, most_segments(in.n_candidates));
  list_rows_kernel<<<blocks_for(segments, kListThreads / 32), kListThreads, 0, stream>>>(in, plan, room, ids);
  check_launch("project_emit");
}

template <>
void project_emit<float>(const Inputs& in, const RankTiles& rank_tiles, const void*, const ProjectIds& ids,
                         const ProjectRoom& room, const ProjectOutputs<float>& out, Workspace&,
                         CudaStream stream) {
  emit_rows(in, rank_tiles, ids, room, out, StayHere{}, stream);
}

void project_emit_to_ranks(const Inputs& in, const RankTiles& rank_tiles, const ProjectIds& ids,
                           const ProjectRoom& room, const ProjectOutputs<float>& out,
                           const ProjectScatter& scatter, Workspace& workspace, CudaStream stream) {
  const auto words = [](const auto* column) { return reinterpret_cast<const std::int32_t*>(column); };
  auto* admitted = workspace.allocate<Admitted>(1);
  admit_kernel<<<1, 32, 0, stream>>>(scatter, in.n_views, room.sizes, ids.row_offsets, admitted);
  check_launch("project_emit");
  RowColumns<const std::int32_t> columns = kEmittedColumns;
  const std::int32_t* data[] = {words(out.means2d),    words(out.conics), words(out.opacities),
                                words(out.colors),     words(out.depths), ids.camera_ids,
                                words(scatter.row_ids)};
  std::copy(std::begin(data), std::end(data), columns.data);
  const GoToRanks destination{
      scatter.ids,     scatter.row_ids, {columns, out.rank_masks, room.sizes.rows},
      scatter.targets, admitted,        {scatter.filled, scatter.places, &admitted->split},
      scatter.n_ranks};
  emit_rows(in, rank_tiles, ids, {room.sizes, &admitted->sizes.visible}, out, destination, stream);
}

}  // namespace blitzgs::cuda
