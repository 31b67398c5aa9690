// SPDX-License-Identifier: Apache-2.0
#include <cub/block/block_reduce.cuh>

#include "project/project_bwd_device.cuh"

namespace blitzgs::cuda {
namespace {

constexpr int kPoseThreads = 256;

// The sink of project_backward_kernel (project_bwd_device.cuh) that writes the gradients of the Gaussians to
// global memory, with one row for each visible Gaussian or (dense) one for each Gaussian.
struct StoreGradients {
  struct Shared {};
  struct Own {};
  ProjectGradients<float> out;
  int64_t stride;  // floats in a row of SH

  __device__ Own begin(Shared&, const WarpRows&) const { return {}; }
  __device__ void take(Shared&, Own&, const WarpRows& warp, TripleStage& triple, const Vec3<float>& v_mean,
                       const float4& v_quat, const Vec3<float>& v_scale, float v_opacity) const {
    if (warp.id >= 0) {
      out.opacities[row(warp)] = v_opacity;
      reinterpret_cast<float4*>(out.quats)[row(warp)] = v_quat;
    }
    if (out.dense) {
      triple.scatter(v_mean, out.means, warp.id, warp.lane);
      triple.scatter(v_scale, out.scales, warp.id, warp.lane);
    } else {
      triple.store(v_mean, out.means + 3 * warp.first, warp.count, warp.lane);
      triple.store(v_scale, out.scales + 3 * warp.first, warp.count, warp.lane);
    }
  }
  template <int DEGREE>
  __device__ void take_sh(Shared&, Own&, const WarpRows& warp, const ShStage<DEGREE>& stage) const {
    if (!out.sh) return;
    if (out.dense) {
      stage.scatter(out.sh, stride, warp.id, warp.lane);
    } else {
      stage.store(out.sh + stride * warp.first, stride, warp.count, warp.lane);
    }
  }
  template <int DEGREE>
  __device__ void take_sh(Shared&, Own&, const WarpRows& warp, const ShRow<DEGREE>& v_sh) const {
    if (!out.sh || warp.id < 0) return;
    float* target = out.sh + stride * row(warp);
#pragma unroll
    for (int i = 0; i < ShRow<DEGREE>::kCount; ++i) target[i] = v_sh.values[i];
    for (int i = ShRow<DEGREE>::kCount; i < stride; ++i) target[i] = 0.f;
  }

 private:
  // The row of the outputs that belongs to this lane's Gaussian.
  __device__ int64_t row(const WarpRows& warp) const { return out.dense ? warp.id : warp.first + warp.lane; }
};

// Computes the gradient of the camera pose of view blockIdx.y from kProjectBlock visible Gaussians. The grid
// is (blocks of visible Gaussians, B), one thread per visible Gaussian at a time. Each block recomputes the
// splats of its Gaussians in its view and writes its sum to partial [blocks, B, 12].
template <class Source>
__global__ void __launch_bounds__(kPoseThreads)
    pose_kernel(const __grid_constant__ BackwardInputs<Source> args, double* partial) {
  __shared__ Camera<float> cameras[kMaxViews];
  using Reduce = cub::BlockReduce<double, kPoseThreads>;
  __shared__ typename Reduce::TempStorage storage;
  const Inputs& in = args.in;
  load_cameras(in, cameras);
  __syncthreads();
  const int view = blockIdx.y;
  PoseGradient<float> pose{};
  for (int round = 0; round < int(kProjectBlock) / kPoseThreads; ++round) {
    const int64_t u = blockIdx.x * kProjectBlock + round * kPoseThreads + threadIdx.x;
    if (u >= args.splats.n_visible) break;
    for (int64_t r = args.splats.splat_offsets[u]; r < args.splats.splat_offsets[u + 1]; ++r) {
      if (args.splats.camera_ids[r] != view) continue;
      const int64_t id = args.splats.visible_ids[u];
      const ActivatedGaussian<float> gaussian = load_gaussian(in, id);
      GaussianGradient<float> unused{};
      project_splat_vjp(cameras[view], gaussian, in.options, args.v.geometry(r), &unused, &pose);
      if (!in.sh || !args.v.colored()) continue;
      const Vec3<float> v_color = args.v.color(r);
      float v_sh[3 * kMaxShBasis] = {};
      splat_color_vjp(cameras[view], gaussian.mean, in.sh + 3 * in.options.sh_stride * id,
                      in.options.sh_degree, &v_color.x, v_sh, &unused.mean, &pose);
    }
  }
  const Vec3<float> columns[4] = {pose.row_x, pose.row_y, pose.row_z, pose.translation};
  double* target = partial + (int64_t(blockIdx.x) * gridDim.y + view) * 12;
  for (int i = 0; i < 4; ++i) {
    const double values[3] = {columns[i].x, columns[i].y, columns[i].z};
    for (int k = 0; k < 3; ++k) {
      const double sum = Reduce(storage).Sum(values[k]);
      __syncthreads();
      if (threadIdx.x == 0) target[3 * i + k] = sum;
    }
  }
}

// Sums the partial pose gradients [n_blocks, B, 12] over the blocks into v_viewmats [B, 4, 4]: a block of 16
// threads for each view, one thread per entry of the matrix. The 12 values of `partial` are the three rows of
// the rotation (9), then the translation (3). The last row of the matrix has the gradient 0.
__global__ void reduce_poses_kernel(const double* partial, int64_t n_blocks, int n_views, float* v_viewmats) {
  const int view = blockIdx.x, i = threadIdx.x;
  const int row = i / 4, column = i % 4;
  double sum = 0;
  const int source = column < 3 ? 3 * row + column : 9 + row;
  if (row < 3) {
    for (int64_t block = 0; block < n_blocks; ++block) sum += partial[(block * n_views + view) * 12 + source];
  }
  v_viewmats[16 * view + i] = float(sum);
}

constexpr int kZeroThreads = 256;

// The arrays begin at multiples of 16 bytes, so a thread writes four floats at a time.
__global__ void __launch_bounds__(kZeroThreads) zero_arrays_kernel(const ZeroedArrays<float> arrays) {
  wait_for_earlier_kernels();
  const int64_t first = blockIdx.x * int64_t{kZeroThreads} + threadIdx.x;
  const int64_t step = gridDim.x * int64_t{kZeroThreads};
#pragma unroll
  for (int a = 0; a < ZeroedArrays<float>::kCount; ++a) {
    float* const begin = arrays.begin[a];
    const int64_t fours = arrays.length[a] / 4;
    for (int64_t i = first; i < fours; i += step) {
      reinterpret_cast<float4*>(begin)[i] = make_float4(0.f, 0.f, 0.f, 0.f);
    }
    const int64_t rest = 4 * fours + first;
    if (rest < arrays.length[a]) begin[rest] = 0.f;
  }
}

}  // namespace

template <> void zero_arrays<float>(const ZeroedArrays<float>& arrays, CudaStream stream) {
  int64_t most = 0;
  for (const int64_t length : arrays.length) most = length > most ? length : most;
  if (most == 0) return;
  launch_early("project_bwd", zero_arrays_kernel,
               {resident_blocks(most, 4 * kZeroThreads, 8), kZeroThreads, stream}, arrays);
}

template <>
void project_bwd<float>(const Inputs& in, const SplatIndex& splats, const SplatGradientSource<float>& v,
                        const Regularisers<float>& regularisers, const ProjectGradients<float>& out,
                        Workspace& workspace, CudaStream stream) {
  const int64_t blocks = project_blocks(splats.n_visible);
  if (out.viewmats && in.n_views > 0) {
    const size_t bytes = 16 * in.n_views * sizeof(float);
    check(cudaMemsetAsync(out.viewmats, 0, bytes, stream), "project_bwd");
  }
  if (blocks == 0) return;
  const StoreGradients sink{out, 3 * in.options.sh_stride};
  dispatch_backward(in, splats, v, regularisers, [&](auto degree, auto quads, const auto& args) {
    launch_backward<degree.value, quads.value>(args, sink, stream);
  });
  if (!out.viewmats) return;
  auto* partial = workspace.allocate<double>(blocks * in.n_views * 12);
  std::visit(
      [&](const auto& source) {
        const BackwardInputs<std::decay_t<decltype(source)>> args{in, splats, source, regularisers};
        const dim3 grid(unsigned(blocks), in.n_views);
        pose_kernel<<<grid, kPoseThreads, 0, stream>>>(args, partial);
      },
      v);
  check_launch("project_bwd");
  reduce_poses_kernel<<<in.n_views, 16, 0, stream>>>(partial, blocks, in.n_views, out.viewmats);
  check_launch("project_bwd");
}

}  // namespace blitzgs::cuda
