// SPDX-License-Identifier: Apache-2.0
// Compiled without FMA contraction (cmake/cuda.cmake): counting and emitting project the same row in two
// kernels, and must get the same bits.
#include <cub/block/block_reduce.cuh>
#include <cub/block/block_scan.cuh>
#include <cub/device/device_scan.cuh>

#include <algorithm>

#include "project/project_device.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kRounds = static_cast<int>(kProjectBlock) / kThreads;
constexpr int kEmitThreads = 128;
constexpr int kCountBlocks = 4096;  // of the exact test, whose work is only known on the device

__device__ std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

__device__ std::int32_t tiles_of(const Row<float>& row, const ProjectOptions<float>& o) {
  return count_tiles(row.mean2d, row.conic, row.opacity, o.width, o.height, o.tile_size);
}

// What the quick test needs of a camera: bounds in float, rounded up.
struct Frustum {
  Vec3<float> row_x, row_y, row_z, translation;
  float fx, fy, cx, cy;
  float largest, offset;   // of the rotation's entries and of the translation's: bounds the rounding of p
  float reach_x, reach_y;  // |d pixel / d world| * z cannot exceed this
};

__device__ float norm1(const Vec3<float>& v) { return fabsf(v.x) + fabsf(v.y) + fabsf(v.z); }
__device__ float top(const Vec3<float>& v) { return fmaxf(fabsf(v.x), fmaxf(fabsf(v.y), fabsf(v.z))); }

__device__ Frustum make_frustum(const Camera<float>& c) {
  Frustum f{c.row_x, c.row_y, c.row_z, c.translation, c.fx, c.fy, c.cx, c.cy, 0.f, 0.f, 0.f, 0.f};
  f.largest = fmaxf(top(c.row_x), fmaxf(top(c.row_y), top(c.row_z)));
  f.offset = top(c.translation);
  const float along = sqrtf(dot(c.row_z, c.row_z));
  const float u = fmaxf(fabsf(c.slope_min_x), fabsf(c.slope_max_x));
  const float v = fmaxf(fabsf(c.slope_min_y), fabsf(c.slope_max_y));
  f.reach_x = 1.01f * fabsf(c.fx) * (sqrtf(dot(c.row_x, c.row_x)) + u * along);
  f.reach_y = 1.01f * fabsf(c.fy) * (sqrtf(dot(c.row_y, c.row_y)) + v * along);
  return f;
}

// A bound on the rounding of any coordinate of p = W mean + t in float.
__device__ float rounding(const Frustum& f, const Vec3<float>& mean) {
  return 1e-6f * (f.largest * norm1(mean) + f.offset);
}

__device__ bool may_be_in_depth(const Frustum& f, const Vec3<float>& mean, const ProjectOptions<float>& o) {
  const float z = dot(f.row_z, mean) + f.translation.z, error = rounding(f, mean);
  return z + error > o.near_plane && z - error <= o.far_plane;
}

// Is the splat's box, no larger than `spread` standard deviations of its largest axis, within [0, size)? All
// times z.
__device__ bool may_overlap(float focal, float centre, float x, float z, float error, float reach,
                            float spread, float sigmas, float root_eps, float size) {
  const float position = focal * x + centre * z;
  const float slack = error * (fabsf(focal) + fabsf(centre) + size) +
                      1e-5f * (fabsf(focal * x) + (fabsf(centre) + size) * fabsf(z));
  const float half = reach * spread + 1.01f * sigmas * root_eps * (z + error) + slack;
  return position + half > 0.f && position - half < size * z;
}

// False only when project_row would be false: no division, no quaternion, floats alone.
__device__ bool may_be_seen(const Frustum& f, const Vec3<float>& mean, float largest_scale, float sigmas,
                            const ProjectOptions<float>& o) {
  if (!may_be_in_depth(f, mean, o)) return false;
  const float z = dot(f.row_z, mean) + f.translation.z, error = rounding(f, mean);
  const float x = dot(f.row_x, mean) + f.translation.x, y = dot(f.row_y, mean) + f.translation.y;
  const float spread = sigmas * largest_scale, root_eps = sqrtf(o.eps2d);
  return may_overlap(f.fx, f.cx, x, z, error, f.reach_x, spread, sigmas, root_eps,
                     static_cast<float>(o.width)) &&
         may_overlap(f.fy, f.cy, y, z, error, f.reach_y, spread, sigmas, root_eps,
                     static_cast<float>(o.height));
}

// How many standard deviations any splat of this candidate can reach; raw opacities never exceed 1.
__device__ float most_sigmas(const Inputs& in, std::int64_t id) {
  return in.options.raw ? 3.331f : 1.0001f * reach(in.opacities[id]);
}

__device__ float largest_scale(const Inputs& in, std::int64_t id) {
  const float* s = in.scales + 3 * id;
  const float widest = fmaxf(s[0], fmaxf(s[1], s[2]));
  return in.options.raw ? 1.0001f * expf(widest) : widest;
}

// The views that may see each of a thread's candidates, from the mean, then the scale.
__device__ void quick_views(const Inputs& in, const Frustum* frusta, std::int64_t first,
                            std::uint32_t* maybe) {
  std::int64_t ids[kRounds];
  Vec3<float> means[kRounds];
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    const std::int64_t c = first + round * kThreads;
    const bool present = c < in.n_candidates;
    ids[round] = present ? candidate_id(in, c) : 0;
    maybe[round] = !present ? 0u : in.active_views ? static_cast<std::uint32_t>(in.active_views[c]) : ~0u;
    if (in.n_views < 32) maybe[round] &= (1u << in.n_views) - 1u;
    means[round] = maybe[round] ? load3(in.means + 3 * ids[round]) : Vec3<float>{0.f, 0.f, 0.f};
  }
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    for (int view = 0; view < in.n_views; ++view) {
      if (!may_be_in_depth(frusta[view], means[round], in.options)) maybe[round] &= ~(1u << view);
    }
  }
  float scales[kRounds], sigmas[kRounds];
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    scales[round] = maybe[round] ? largest_scale(in, ids[round]) : 0.f;
    sigmas[round] = maybe[round] ? most_sigmas(in, ids[round]) : 0.f;
  }
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    for (int view = 0; view < in.n_views && maybe[round]; ++view) {
      if (!may_be_seen(frusta[view], means[round], scales[round], sigmas[round], in.options)) {
        maybe[round] &= ~(1u << view);
      }
    }
  }
}

template <int DEGREE, bool QUADS>
__device__ bool has_finite_sh(const Inputs& in, std::int64_t id) {
  const float* sh = in.sh + 3 * in.options.sh_stride * id;
  if constexpr (QUADS) {
    float zero = 0.f;
#pragma unroll
    for (int i = 0; i < ShRow<DEGREE>::kQuads; ++i) {
      const float4 v = reinterpret_cast<const float4*>(sh)[i];
      zero += 0.f * v.x + 0.f * v.y + 0.f * v.z + 0.f * v.w;
    }
    return zero == 0.f;
  } else {
    return finite_sh(sh, DEGREE);
  }
}

// The views that do see a candidate, of those that may, and the tiles its rows touch.
template <int DEGREE, bool QUADS>
__device__ std::uint32_t exact_views(const Inputs& in, const Camera<float>* cameras, std::int64_t candidate,
                                     std::uint32_t maybe, std::int64_t* tiles) {
  const std::int64_t id = candidate_id(in, candidate);
  const ActiveGaussian<float> gaussian = load_gaussian(in, id);
  std::uint32_t seen = 0;
  std::int64_t touched = 0;
  for (; maybe; maybe &= maybe - 1) {
    const int view = __ffs(maybe) - 1;
    Row<float> row{};
    if (!project_row(cameras[view], gaussian, in.options, &row)) continue;
    seen |= 1u << view;
    touched += tiles_of(row, in.options);
  }
  if (seen == 0 || (in.sh && !has_finite_sh<DEGREE, QUADS>(in, id))) return 0;
  *tiles += touched;
  return seen;
}

// Visible candidates and rows in one number, so that one scan serves both: neither can exceed 2^31 - 1.
__device__ std::int64_t pack_counts(std::int64_t visible, std::int64_t rows) { return visible << 32 | rows; }

// What counting leaves on the device. left [candidates]: those the quick test leaves over, in any order.
struct CountState {
  std::int32_t* left;
  unsigned long long* totals;  // visible, rows, tiles, length of left; zeroed
};

// view_masks: the views that may see each candidate.
__global__ void __launch_bounds__(kThreads)
    quick_kernel(const Inputs in, const ProjectPlan plan, const CountState state) {
  __shared__ Frustum frusta[kMaxViews];
  __shared__ int n_left;
  __shared__ unsigned long long first_left;
  if (threadIdx.x == 0) n_left = 0;
  for (int view = threadIdx.x; view < in.n_views; view += kThreads) {
    frusta[view] = make_frustum(
        make_camera(in.viewmats + 16 * view, in.Ks + 9 * view, in.options.width, in.options.height));
  }
  __syncthreads();
  const std::int64_t base = blockIdx.x * kProjectBlock + threadIdx.x;
  std::uint32_t maybe[kRounds];
  int slots[kRounds];
  quick_views(in, frusta, base, maybe);
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    const std::int64_t c = base + round * kThreads;
    if (c < in.n_candidates) plan.view_masks[c] = maybe[round];
    if (maybe[round]) slots[round] = atomicAdd(&n_left, 1);
  }
  __syncthreads();
  if (threadIdx.x == 0) {
    plan.visible_before[blockIdx.x] = 0;
    first_left = n_left ? atomicAdd(state.totals + 3, static_cast<unsigned long long>(n_left)) : 0;
  }
  __syncthreads();
#pragma unroll
  for (int round = 0; round < kRounds; ++round) {
    if (maybe[round])
      state.left[first_left + slots[round]] = static_cast<std::int32_t>(base + round * kThreads);
  }
}

// view_masks of what is left becomes exact, and visible_before the pack_counts() of each block.
template <int DEGREE, bool QUADS>
__global__ void __launch_bounds__(kThreads, 3)
    count_kernel(const Inputs in, const ProjectPlan plan, const CountState state) {
  __shared__ Camera<float> cameras[kMaxViews];
  using Reduce = cub::BlockReduce<std::int64_t, kThreads>;
  __shared__ typename Reduce::TempStorage storage[3];
  load_cameras(in, cameras);
  __syncthreads();
  const auto n_left = static_cast<std::int64_t>(state.totals[3]);
  std::int64_t visible = 0, rows = 0, tiles = 0;
  for (std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x; i < n_left;
       i += static_cast<std::int64_t>(gridDim.x) * kThreads) {
    const std::int32_t c = state.left[i];
    const std::uint32_t seen = exact_views<DEGREE, QUADS>(in, cameras, c, plan.view_masks[c], &tiles);
    plan.view_masks[c] = seen;
    if (seen == 0) continue;
    visible += 1;
    rows += __popc(seen);
    atomicAdd(reinterpret_cast<unsigned long long*>(plan.visible_before) + c / kProjectBlock,
              static_cast<unsigned long long>(pack_counts(1, __popc(seen))));
  }
  visible = Reduce(storage[0]).Sum(visible);
  rows = Reduce(storage[1]).Sum(rows);
  tiles = Reduce(storage[2]).Sum(tiles);
  if (threadIdx.x > 0 || rows == 0) return;
  atomicAdd(state.totals, static_cast<unsigned long long>(visible));
  atomicAdd(state.totals + 1, static_cast<unsigned long long>(rows));
  atomicAdd(state.totals + 2, static_cast<unsigned long long>(tiles));
}

// Which Gaussian and view each row is of. plan.visible_before: pack_counts() before each block.
__global__ void __launch_bounds__(kThreads)
    list_rows_kernel(const Inputs in, const ProjectPlan plan, const ProjectCounts counts,
                     const ProjectOutputs<float> out) {
  using Scan = cub::BlockScan<std::int64_t, kThreads>;
  __shared__ typename Scan::TempStorage storage;
  if (blockIdx.x == 0 && threadIdx.x == 0) {
    out.row_offsets[counts.visible] = static_cast<std::int32_t>(counts.rows);
  }
  const std::int64_t before = plan.visible_before[blockIdx.x];
  const std::int64_t after =
      blockIdx.x + 1 < gridDim.x ? plan.visible_before[blockIdx.x + 1] : counts.visible << 32 | counts.rows;
  if (before == after) return;
  const std::int64_t first = blockIdx.x * kProjectBlock + threadIdx.x * kRounds;
  std::uint32_t masks[kRounds];
  std::int64_t mine = 0;
#pragma unroll
  for (int k = 0; k < kRounds; ++k) {
    masks[k] = first + k < in.n_candidates ? plan.view_masks[first + k] : 0;
    mine += pack_counts(masks[k] != 0, __popc(masks[k]));
  }
  std::int64_t position;
  Scan(storage).ExclusiveSum(mine, position);
  position += before;
#pragma unroll
  for (int k = 0; k < kRounds; ++k) {
    if (!masks[k]) continue;
    const auto id = static_cast<std::int32_t>(candidate_id(in, first + k));
    const std::int64_t u = position >> 32;
    std::int64_t at = position & 0xffffffff;
    out.visible_ids[u] = id;
    out.row_offsets[u] = static_cast<std::int32_t>(at);
    for (std::uint32_t mask = masks[k]; mask; mask &= mask - 1, ++at) {
      out.gaussian_ids[at] = id;
      out.camera_ids[at] = __ffs(mask) - 1;
    }
    position += pack_counts(1, __popc(masks[k]));
  }
}

template <int DEGREE, bool QUADS>
__global__ void __launch_bounds__(kEmitThreads)
    emit_kernel(const Inputs in, const ProjectOutputs<float> out, std::int64_t n_rows) {
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ ShStage<DEGREE> stages[QUADS ? kEmitThreads / 32 : 1];
  __shared__ TripleStage triples[kEmitThreads / 32];
  const int lane = threadIdx.x % 32;
  TripleStage& triple = triples[threadIdx.x / 32];
  ShStage<DEGREE>& stage = stages[QUADS ? threadIdx.x / 32 : 0];
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kEmitThreads) + threadIdx.x;
  const std::int32_t id = i < n_rows ? out.gaussian_ids[i] : -1;
  if constexpr (QUADS) stage.gather(in.sh, 3 * in.options.sh_stride, id, lane);
  load_cameras(in, cameras);
  __syncthreads();
  const Camera<float>& camera = cameras[id < 0 ? 0 : out.camera_ids[i]];
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
    out.tiles_touched[i] = tiles_of(row, in.options);
  }
  if (!in.sh) return;
  if constexpr (QUADS) {
    stage.wait();
    if (id < 0) return;
    ShRow<DEGREE> sh;
    stage.read(lane, &sh);
    row_color(camera, mean, sh.values, DEGREE, out.colors + 3 * i);
  } else if (id >= 0) {
    row_color(camera, mean, in.sh + 3 * in.options.sh_stride * std::int64_t{id}, DEGREE, out.colors + 3 * i);
  }
}

// Turns the counts of blocks into the counts before each.
void scan_blocks(std::int64_t* counts, std::int64_t n, Workspace& workspace, CudaStream stream) {
  std::size_t bytes = 0;
  check(cub::DeviceScan::ExclusiveSum(nullptr, bytes, counts, counts, n, stream), "project_fwd");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceScan::ExclusiveSum(scratch, bytes, counts, counts, n, stream), "project_fwd");
}

}  // namespace

template <>
void project_count<float>(const Inputs& in, const ProjectPlan& plan, ProjectCounts* counts,
                          Workspace& workspace, CudaStream stream) {
  *counts = {};
  const std::int64_t blocks = project_blocks(in.n_candidates);
  if (blocks == 0 || in.n_views == 0) return;
  constexpr int kTotals = 4;
  const CountState state{workspace.allocate<std::int32_t>(in.n_candidates),
                         workspace.allocate<unsigned long long>(kTotals)};
  check(cudaMemsetAsync(state.totals, 0, kTotals * sizeof(*state.totals), stream), "project_fwd");
  quick_kernel<<<static_cast<unsigned>(blocks), kThreads, 0, stream>>>(in, plan, state);
  check_launch("project_fwd");
  const auto grid =
      static_cast<unsigned>(std::min<std::int64_t>(kCountBlocks, blocks_for(in.n_candidates, kThreads)));
  dispatch_sh(in, [&](auto degree, auto quads) {
    count_kernel<degree.value, quads.value><<<grid, kThreads, 0, stream>>>(in, plan, state);
  });
  check_launch("project_fwd");
  scan_blocks(plan.visible_before, blocks, workspace, stream);
  unsigned long long host[3];
  check(cudaMemcpyAsync(host, state.totals, sizeof(host), cudaMemcpyDeviceToHost, stream), "project_fwd");
  check(cudaStreamSynchronize(stream), "project_fwd");
  counts->visible = static_cast<std::int64_t>(host[0]);
  counts->rows = static_cast<std::int64_t>(host[1]);
  counts->tiles = static_cast<std::int64_t>(host[2]);
}

template <>
void project_emit<float>(const Inputs& in, const ProjectPlan& plan, const ProjectCounts& counts,
                         const ProjectOutputs<float>& out, Workspace&, CudaStream stream) {
  if (counts.rows == 0) {
    check(cudaMemsetAsync(out.row_offsets, 0, sizeof(std::int32_t), stream), "project_fwd");
    return;
  }
  const auto blocks = static_cast<unsigned>(project_blocks(in.n_candidates));
  list_rows_kernel<<<blocks, kThreads, 0, stream>>>(in, plan, counts, out);
  check_launch("project_fwd");
  dispatch_sh(in, [&](auto degree, auto quads) {
    emit_kernel<degree.value, quads.value>
        <<<blocks_for(counts.rows, kEmitThreads), kEmitThreads, 0, stream>>>(in, out, counts.rows);
  });
  check_launch("project_fwd");
}

}  // namespace blitzgs::cuda
