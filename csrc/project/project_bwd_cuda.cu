// SPDX-License-Identifier: Apache-2.0
#include <cub/block/block_reduce.cuh>

#include "project/project_device.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kThreads = 128;
constexpr int kPoseThreads = 256;

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

// A thread is a visible Gaussian.
template <int DEGREE, bool QUADS>
__global__ void __launch_bounds__(kThreads, 3)
    backward_kernel(const BackwardInputs args, const ProjectGradients<float> out) {
  using Coefficients = ShRow<DEGREE>;
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ ShStage<DEGREE> stages[QUADS ? kThreads / 32 : 1];
  __shared__ TripleStage triples[kThreads / 32];
  const Inputs& in = args.in;
  const int lane = threadIdx.x % 32;
  ShStage<DEGREE>& stage = stages[QUADS ? threadIdx.x / 32 : 0];
  TripleStage& triple = triples[threadIdx.x / 32];
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x / 32 * 32;
  const std::int64_t u = first + lane;
  const std::int32_t id = u < args.rows.n_visible ? args.rows.visible_ids[u] : -1;
  const std::int64_t stride = 3 * in.options.sh_stride;
  const bool has_colors = in.sh && args.v.colors;
  if constexpr (QUADS) {
    if (has_colors) stage.gather(in.sh, stride, id, lane);
  }
  load_cameras(in, cameras);
  __syncthreads();
  const Vec3<float> mean = triple.gather(in.means, id, lane), scale = triple.gather(in.scales, id, lane);

  Vec3<float> v_mean{}, v_scale{};
  const ActiveGaussian<float> gaussian = make_gaussian(in, id < 0 ? 0 : id, mean, scale);
  GaussianGradient<float> gradient{};
  float axis_weight = 0.f;
  const std::int32_t begin = id < 0 ? 0 : args.rows.row_offsets[u],
                     end = id < 0 ? 0 : args.rows.row_offsets[u + 1];
  PoseGradient<float>* no_pose = nullptr;
  for (std::int64_t r = begin; r < end; ++r) {
    const int view = args.rows.camera_ids[r];
    project_row_vjp(cameras[view], gaussian, in.options, load_row_gradient(args.v, r), &gradient, no_pose);
    if (args.scale_reg) axis_weight += args.scale_reg[view];
  }

  // The colours after the geometry, so that their coefficients are in registers for no longer than needed.
  Coefficients v_sh;
#pragma unroll
  for (float& value : v_sh.values) value = 0.f;
  if (has_colors) {
    Coefficients sh;
    if constexpr (QUADS) {
      stage.wait();
      stage.read(lane, &sh);
      __syncwarp();
    } else if (id >= 0) {
#pragma unroll
      for (int i = 0; i < Coefficients::kCount; ++i) sh.values[i] = in.sh[stride * id + i];
    }
    for (std::int64_t r = begin; r < end; ++r) {
      const float v_color[3] = {args.v.colors[3 * r], args.v.colors[3 * r + 1], args.v.colors[3 * r + 2]};
      row_color_vjp(cameras[args.rows.camera_ids[r]], mean, sh.values, DEGREE, v_color, v_sh.values,
                    &gradient.mean, no_pose);
    }
  }
  if (id >= 0) {
    float v_quat[4];
    activate_gaussian_vjp(gaussian, in.options.raw, gradient, axis_weight,
                          ParameterGradients<float>{&v_mean.x, v_quat, &v_scale.x, out.opacities + u});
    reinterpret_cast<float4*>(out.quats)[u] = {v_quat[0], v_quat[1], v_quat[2], v_quat[3]};
  }
  const std::int64_t rows = args.rows.n_visible - first;
  triple.store(v_mean, out.means + 3 * first, rows, lane);
  triple.store(v_scale, out.scales + 3 * first, rows, lane);
  if (!out.sh) return;
  if constexpr (QUADS) {
    stage.write(lane, v_sh);
    stage.store(out.sh + stride * first, stride, rows, lane);
  } else if (id >= 0) {
    float* target = out.sh + stride * u;
#pragma unroll
    for (int i = 0; i < Coefficients::kCount; ++i) target[i] = v_sh.values[i];
    for (int i = Coefficients::kCount; i < stride; ++i) target[i] = 0.f;
  }
}

// One block's share of the gradients of view blockIdx.y: [blocks, B, 12] doubles.
__global__ void __launch_bounds__(kPoseThreads) pose_kernel(const BackwardInputs args, double* partial) {
  __shared__ Camera<float> cameras[kMaxViews];
  using Reduce = cub::BlockReduce<double, kPoseThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const Inputs& in = args.in;
  load_cameras(in, cameras);
  __syncthreads();
  const int view = blockIdx.y;
  PoseGradient<float> pose{};
  for (int round = 0; round < static_cast<int>(kProjectBlock) / kPoseThreads; ++round) {
    const std::int64_t u = blockIdx.x * kProjectBlock + round * kPoseThreads + threadIdx.x;
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

}  // namespace

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
  dispatch_sh(in, [&](auto degree, auto quads) {
    backward_kernel<degree.value, quads.value>
        <<<blocks_for(rows.n_visible, kThreads), kThreads, 0, stream>>>(args, out);
  });
  check_launch("project_bwd");
  if (!out.viewmats) return;
  auto* partial = workspace.allocate<double>(blocks * in.n_views * 12);
  pose_kernel<<<dim3(static_cast<unsigned>(blocks), in.n_views), kPoseThreads, 0, stream>>>(args, partial);
  check_launch("project_bwd");
  reduce_poses_kernel<<<in.n_views, 16, 0, stream>>>(partial, blocks, in.n_views, out.viewmats);
  check_launch("project_bwd");
}

}  // namespace blitzgs::cuda
