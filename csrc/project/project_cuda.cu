// SPDX-License-Identifier: Apache-2.0
// Compiled without FMA contraction (cmake/cuda.cmake): counting and emitting project the same row in two
// kernels, and must get the same bits.
#include <cub/block/block_reduce.cuh>
#include <cub/block/block_scan.cuh>
#include <cub/device/device_scan.cuh>

#include "common/cuda_check.h"
#include "project/project.h"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 256;
constexpr int kRounds = static_cast<int>(kProjectBlock) / kThreads;
using Inputs = ProjectInputs<float>;

// The cameras of a launch in shared memory; the caller synchronises.
__device__ void load_cameras(const Inputs& in, Camera<float>* cameras) {
  for (int view = threadIdx.x; view < in.n_views; view += blockDim.x) {
    cameras[view] =
        make_camera(in.viewmats + 16 * view, in.Ks + 9 * view, in.options.width, in.options.height);
  }
}

__device__ std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

__device__ void load_quat(const Inputs& in, std::int64_t id, float* quat) {
  const float4 q = reinterpret_cast<const float4*>(in.quats)[id];
  quat[0] = q.x;
  quat[1] = q.y;
  quat[2] = q.z;
  quat[3] = q.w;
}

__device__ ActiveGaussian<float> load_gaussian(const Inputs& in, std::int64_t id) {
  float quat[4];
  load_quat(in, id, quat);
  return activate_gaussian(load3(in.means + 3 * id), quat, activate_scale(in.scales + 3 * id, in.options.raw),
                           activate_opacity(in.opacities[id], in.options.raw));
}

__device__ std::int32_t tiles_of(const Row<float>& row, const ProjectOptions<float>& o) {
  return count_tiles(row.mean2d, row.conic, row.opacity, o.width, o.height, o.tile_size);
}

// The views that see a candidate, and the tiles its rows touch. Reads the mean first, then scale and opacity,
// then the quaternion and SH, each only if what came before leaves the candidate visible.
__device__ std::uint32_t visible_views(const Inputs& in, const Camera<float>* cameras, std::int64_t candidate,
                                       std::int64_t* tiles) {
  const std::int64_t id = candidate_id(in, candidate);
  std::uint32_t maybe = in.active_views ? static_cast<std::uint32_t>(in.active_views[candidate]) : ~0u;
  const Vec3<float> mean = load3(in.means + 3 * id);
  for (int view = 0; view < in.n_views; ++view) {
    if (!in_depth_range(camera_depth(cameras[view], mean), in.options)) maybe &= ~(1u << view);
  }
  if (in.n_views < 32) maybe &= (1u << in.n_views) - 1u;
  if (maybe == 0) return 0;
  const Vec3<float> scale = activate_scale(in.scales + 3 * id, in.options.raw);
  const float opacity = activate_opacity(in.opacities[id], in.options.raw);
  const float sigmas = reach(opacity), widest = widest_variance(scale);
  if (sigmas < 0.0f) return 0;
  for (int view = 0; view < in.n_views; ++view) {
    if ((maybe >> view & 1u) && !may_touch_image(cameras[view], mean, widest, sigmas, in.options)) {
      maybe &= ~(1u << view);
    }
  }
  if (maybe == 0) return 0;
  if (in.sh && !finite_sh(in.sh + 3 * in.options.sh_stride * id, in.options.sh_degree)) return 0;
  float quat[4];
  load_quat(in, id, quat);
  const ActiveGaussian<float> gaussian = activate_gaussian(mean, quat, scale, opacity);
  std::uint32_t seen = 0;
  for (int view = 0; view < in.n_views; ++view) {
    Row<float> row{};
    if (!(maybe >> view & 1u) || !project_row(cameras[view], gaussian, in.options, &row)) continue;
    seen |= 1u << view;
    *tiles += tiles_of(row, in.options);
  }
  return seen;
}

// totals: visible, rows, tiles; zeroed by the caller.
__global__ void __launch_bounds__(kThreads)
    count_kernel(const Inputs in, const ProjectPlan plan, unsigned long long* totals) {
  __shared__ Camera<float> cameras[kMaxViews];
  using Reduce = cub::BlockReduce<std::int64_t, kThreads>;
  __shared__ typename Reduce::TempStorage storage[3];
  load_cameras(in, cameras);
  __syncthreads();
  std::int64_t visible = 0, rows = 0, tiles = 0;
  for (int round = 0; round < kRounds; ++round) {
    const std::int64_t c = blockIdx.x * kProjectBlock + round * kThreads + threadIdx.x;
    if (c >= in.n_candidates) break;
    const std::uint32_t seen = visible_views(in, cameras, c, &tiles);
    plan.view_masks[c] = seen;
    visible += seen != 0;
    rows += __popc(seen);
  }
  visible = Reduce(storage[0]).Sum(visible);
  rows = Reduce(storage[1]).Sum(rows);
  tiles = Reduce(storage[2]).Sum(tiles);
  if (threadIdx.x > 0) return;
  plan.visible_before[blockIdx.x] = visible;
  plan.rows_before[blockIdx.x] = rows;
  atomicAdd(totals, static_cast<unsigned long long>(visible));
  atomicAdd(totals + 1, static_cast<unsigned long long>(rows));
  atomicAdd(totals + 2, static_cast<unsigned long long>(tiles));
}

// Turns the counts of blocks into the counts before each.
void scan_blocks(std::int64_t* counts, std::int64_t n, Workspace& workspace, CudaStream stream) {
  std::size_t bytes = 0;
  check(cub::DeviceScan::ExclusiveSum(nullptr, bytes, counts, counts, n, stream), "project_fwd");
  void* scratch = workspace.allocate_bytes(bytes);
  check(cub::DeviceScan::ExclusiveSum(scratch, bytes, counts, counts, n, stream), "project_fwd");
}

// Which Gaussian and view each row is of.
__global__ void __launch_bounds__(kThreads)
    list_rows_kernel(const Inputs in, const ProjectPlan plan, const ProjectOutputs<float> out) {
  using Scan = cub::BlockScan<int, kThreads>;
  __shared__ typename Scan::TempStorage storage[2];
  std::int64_t visible_before = plan.visible_before[blockIdx.x], rows_before = plan.rows_before[blockIdx.x];
  for (int round = 0; round < kRounds; ++round) {
    const std::int64_t c = blockIdx.x * kProjectBlock + round * kThreads + threadIdx.x;
    std::uint32_t mask = c < in.n_candidates ? plan.view_masks[c] : 0;
    int u, row, n_visible, n_rows;
    Scan(storage[0]).ExclusiveSum(mask != 0, u, n_visible);
    Scan(storage[1]).ExclusiveSum(__popc(mask), row, n_rows);
    if (mask) {
      const auto id = static_cast<std::int32_t>(candidate_id(in, c));
      std::int64_t at = rows_before + row;
      out.visible_ids[visible_before + u] = id;
      out.row_offsets[visible_before + u] = static_cast<std::int32_t>(at);
      for (; mask; mask &= mask - 1, ++at) {
        out.gaussian_ids[at] = id;
        out.camera_ids[at] = __ffs(mask) - 1;
      }
    }
    visible_before += n_visible;
    rows_before += n_rows;
    __syncthreads();
  }
  if (blockIdx.x == gridDim.x - 1 && threadIdx.x == 0) {
    out.row_offsets[visible_before] = static_cast<std::int32_t>(rows_before);
  }
}

// The coefficients in use, as registers; 16-byte loads where the rows are aligned to them.
template <int DEGREE>
struct ShCoefficients {
  static constexpr int kCount = 3 * (DEGREE + 1) * (DEGREE + 1);
  float values[(kCount + 3) / 4 * 4];

  __device__ __forceinline__ void load(const float* sh, int stride) {
    if (stride % 4 == 0 && kCount % 4 == 0) {
#pragma unroll
      for (int i = 0; i < kCount / 4; ++i) {
        const float4 v = reinterpret_cast<const float4*>(sh)[i];
        values[4 * i] = v.x;
        values[4 * i + 1] = v.y;
        values[4 * i + 2] = v.z;
        values[4 * i + 3] = v.w;
      }
    } else {
#pragma unroll
      for (int i = 0; i < kCount; ++i) values[i] = sh[i];
    }
  }
};

template <int DEGREE>
__global__ void __launch_bounds__(kThreads)
    emit_kernel(const Inputs in, const ProjectOutputs<float> out, std::int64_t n_rows) {
  __shared__ Camera<float> cameras[kMaxViews];
  load_cameras(in, cameras);
  __syncthreads();
  const std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  if (i >= n_rows) return;
  const std::int64_t id = out.gaussian_ids[i];
  const Camera<float>& camera = cameras[out.camera_ids[i]];
  ShCoefficients<DEGREE> sh;
  if (in.sh) sh.load(in.sh + 3 * in.options.sh_stride * id, 3 * in.options.sh_stride);
  const ActiveGaussian<float> gaussian = load_gaussian(in, id);
  Row<float> row{};
  project_row(camera, gaussian, in.options, &row);
  reinterpret_cast<float2*>(out.means2d)[i] = {row.mean2d[0], row.mean2d[1]};
  for (int k = 0; k < 3; ++k) out.conics[3 * i + k] = row.conic[k];
  out.depths[i] = row.depth;
  out.opacities[i] = row.opacity;
  reinterpret_cast<int2*>(out.radii)[i] = {pixel_radius(row.extent[0]), pixel_radius(row.extent[1])};
  out.tiles_touched[i] = tiles_of(row, in.options);
  if (in.sh) row_color(camera, gaussian.mean, sh.values, DEGREE, out.colors + 3 * i);
}

struct BackwardInputs {
  Inputs in;
  ProjectRows rows;
  ProjectRowGradients<float> v;
  const float* scale_reg;
};

__device__ RowGradient<float> load_row_gradient(const ProjectRowGradients<float>& v, std::int64_t r) {
  return {{v.means2d[2 * r], v.means2d[2 * r + 1]},
          {v.conics[3 * r], v.conics[3 * r + 1], v.conics[3 * r + 2]},
          v.depths ? v.depths[r] : 0.f,
          v.opacities[r]};
}

template <int DEGREE>
__global__ void __launch_bounds__(128)
    backward_kernel(const BackwardInputs args, const ProjectGradients<float> out) {
  __shared__ Camera<float> cameras[kMaxViews];
  load_cameras(args.in, cameras);
  __syncthreads();
  const std::int64_t u = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x;
  if (u >= args.rows.n_visible) return;
  using Coefficients = ShCoefficients<DEGREE>;
  const Inputs& in = args.in;
  const std::int64_t id = args.rows.visible_ids[u];
  const int stride = 3 * in.options.sh_stride;
  const bool has_colors = in.sh && args.v.colors;
  Coefficients sh, v_sh;
  if (has_colors) sh.load(in.sh + stride * id, stride);
#pragma unroll
  for (float& value : v_sh.values) value = 0.f;
  const ActiveGaussian<float> gaussian = load_gaussian(in, id);
  GaussianGradient<float> gradient{};
  float axis_weight = 0.f;
  const std::int32_t last = args.rows.row_offsets[u + 1];
  for (std::int64_t r = args.rows.row_offsets[u]; r < last; ++r) {
    const int view = args.rows.camera_ids[r];
    PoseGradient<float>* no_pose = nullptr;
    project_row_vjp(cameras[view], gaussian, in.options, load_row_gradient(args.v, r), &gradient, no_pose);
    if (has_colors) {
      const float v_color[3] = {args.v.colors[3 * r], args.v.colors[3 * r + 1], args.v.colors[3 * r + 2]};
      row_color_vjp(cameras[view], gaussian.mean, sh.values, DEGREE, v_color, v_sh.values, &gradient.mean,
                    no_pose);
    }
    if (args.scale_reg) axis_weight += args.scale_reg[view];
  }
  float v_quat[4];
  activate_gaussian_vjp(
      gaussian, in.options.raw, gradient, axis_weight,
      ParameterGradients<float>{out.means + 3 * u, v_quat, out.scales + 3 * u, out.opacities + u});
  reinterpret_cast<float4*>(out.quats)[u] = {v_quat[0], v_quat[1], v_quat[2], v_quat[3]};
  if (!out.sh) return;
  float* target = out.sh + stride * u;
  if (stride == Coefficients::kCount && stride % 4 == 0) {
#pragma unroll
    for (int i = 0; i < Coefficients::kCount / 4; ++i) {
      reinterpret_cast<float4*>(target)[i] = {v_sh.values[4 * i], v_sh.values[4 * i + 1],
                                              v_sh.values[4 * i + 2], v_sh.values[4 * i + 3]};
    }
  } else {
#pragma unroll
    for (int i = 0; i < Coefficients::kCount; ++i) target[i] = v_sh.values[i];
    for (int i = Coefficients::kCount; i < stride; ++i) target[i] = 0.f;
  }
}

// One block's share of the gradients of view blockIdx.y: [blocks, B, 12] doubles.
__global__ void __launch_bounds__(kThreads) pose_kernel(const BackwardInputs args, double* partial) {
  __shared__ Camera<float> cameras[kMaxViews];
  using Reduce = cub::BlockReduce<double, kThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const Inputs& in = args.in;
  load_cameras(in, cameras);
  __syncthreads();
  const int view = blockIdx.y;
  PoseGradient<float> pose{};
  for (int round = 0; round < kRounds; ++round) {
    const std::int64_t u = blockIdx.x * kProjectBlock + round * kThreads + threadIdx.x;
    if (u >= args.rows.n_visible) break;
    for (std::int64_t r = args.rows.row_offsets[u]; r < args.rows.row_offsets[u + 1]; ++r) {
      if (args.rows.camera_ids[r] != view) continue;
      const std::int64_t id = args.rows.visible_ids[u];
      const ActiveGaussian<float> gaussian = load_gaussian(in, id);
      GaussianGradient<float> unused{};
      project_row_vjp(cameras[view], gaussian, in.options, load_row_gradient(args.v, r), &unused, &pose);
      if (!in.sh || !args.v.colors) continue;
      float v_sh[3 * kMaxShBasis] = {};
      row_color_vjp(cameras[view], gaussian.mean, in.sh + 3 * in.options.sh_stride * id, in.options.sh_degree,
                    args.v.colors + 3 * r, v_sh, &unused.mean, &pose);
    }
  }
  const Vec3<float> columns[4] = {pose.row_x, pose.row_y, pose.row_z, pose.translation};
  double* target = partial + (static_cast<std::int64_t>(blockIdx.x) * gridDim.y + view) * 12;
  for (int i = 0; i < 4; ++i) {
    const double values[3] = {columns[i].x, columns[i].y, columns[i].z};
    for (int k = 0; k < 3; ++k) {
      const double sum = Reduce(storage).Sum(values[k]);
      __syncthreads();
      if (threadIdx.x == 0) target[3 * i + k] = sum;
    }
  }
}

// partial is in the order rotation rows (9), translation (3).
__global__ void reduce_poses_kernel(const double* partial, std::int64_t n_blocks, int n_views,
                                    float* v_viewmats) {
  const int view = blockIdx.x, i = threadIdx.x;
  const int row = i / 4, column = i % 4;
  double sum = 0;
  const int source = column < 3 ? 3 * row + column : 9 + row;
  if (row < 3) {
    for (std::int64_t block = 0; block < n_blocks; ++block)
      sum += partial[(block * n_views + view) * 12 + source];
  }
  v_viewmats[16 * view + i] = static_cast<float>(sum);
}

// Calls f with the degree as a type; 0 without SH.
template <class F>
void dispatch_degree(const Inputs& in, const F& f) {
  switch (in.sh ? in.options.sh_degree : 0) {
    case 0:
      return f(std::integral_constant<int, 0>{});
    case 1:
      return f(std::integral_constant<int, 1>{});
    case 2:
      return f(std::integral_constant<int, 2>{});
    default:
      return f(std::integral_constant<int, 3>{});
  }
}

}  // namespace

template <>
void project_count<float>(const Inputs& in, const ProjectPlan& plan, ProjectCounts* counts,
                          Workspace& workspace, CudaStream stream) {
  *counts = {};
  const std::int64_t blocks = project_blocks(in.n_candidates);
  if (blocks == 0 || in.n_views == 0) return;
  auto* totals = workspace.allocate<unsigned long long>(3);
  check(cudaMemsetAsync(totals, 0, 3 * sizeof(*totals), stream), "project_fwd");
  count_kernel<<<static_cast<unsigned>(blocks), kThreads, 0, stream>>>(in, plan, totals);
  check_launch("project_fwd");
  scan_blocks(plan.visible_before, blocks, workspace, stream);
  scan_blocks(plan.rows_before, blocks, workspace, stream);
  unsigned long long host[3];
  check(cudaMemcpyAsync(host, totals, sizeof(host), cudaMemcpyDeviceToHost, stream), "project_fwd");
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
  list_rows_kernel<<<blocks, kThreads, 0, stream>>>(in, plan, out);
  check_launch("project_fwd");
  dispatch_degree(in, [&](auto degree) {
    emit_kernel<degree.value>
        <<<blocks_for(counts.rows, kThreads), kThreads, 0, stream>>>(in, out, counts.rows);
  });
  check_launch("project_fwd");
}

template <>
void project_bwd<float>(const Inputs& in, const ProjectRows& rows, const ProjectRowGradients<float>& v,
                        const float* scale_reg, const ProjectGradients<float>& out, Workspace& workspace,
                        CudaStream stream) {
  const std::int64_t blocks = project_blocks(rows.n_visible);
  if (out.viewmats && in.n_views > 0) {
    const std::size_t bytes = 16 * in.n_views * sizeof(float);
    check(cudaMemsetAsync(out.viewmats, 0, bytes, stream), "project_bwd");
  }
  if (blocks == 0) return;
  const BackwardInputs args{in, rows, v, scale_reg};
  dispatch_degree(in, [&](auto degree) {
    backward_kernel<degree.value><<<blocks_for(rows.n_visible, 128), 128, 0, stream>>>(args, out);
  });
  check_launch("project_bwd");
  if (!out.viewmats) return;
  auto* partial = workspace.allocate<double>(blocks * in.n_views * 12);
  pose_kernel<<<dim3(static_cast<unsigned>(blocks), in.n_views), kThreads, 0, stream>>>(args, partial);
  check_launch("project_bwd");
  reduce_poses_kernel<<<in.n_views, 16, 0, stream>>>(partial, blocks, in.n_views, out.viewmats);
  check_launch("project_bwd");
}

}  // namespace blitzgs::cuda
