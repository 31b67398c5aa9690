// SPDX-License-Identifier: Apache-2.0
// The kernel of the projection's backward pass on CUDA. It gives the gradients of the parameters to a sink:
// that of project_bwd_cuda.cu stores them, that of project_step_cuda.cu takes the optimiser's step with them.
#pragma once
#include "project/project.h"
#include "project/project_device.cuh"

namespace blitzgs::cuda {

constexpr int kBackwardThreads = 128;

// v: the gradients of the splats, one alternative of SplatGradientSource.
template <class Source> struct BackwardInputs {
  Inputs in;
  SplatIndex splats;
  Source v;
  Regularisers<float> regularisers;
};

// Calls f(degree, quads, BackwardInputs); dispatch_sh says what degree and quads are.
template <class F>
void dispatch_backward(const Inputs& in, const SplatIndex& splats, const SplatGradientSource<float>& v,
                       const Regularisers<float>& regularisers, const F& f) {
  std::visit(
      [&](const auto& source) {
        const BackwardInputs<std::decay_t<decltype(source)>> args{in, splats, source, regularisers};
        dispatch_sh(in, [&](auto degree, auto quads) { f(degree, quads, args); });
      },
      v);
}

// The visible Gaussians of a warp, one per lane.
struct WarpRows {
  int64_t first;   // the position of the first of them in visible_ids
  int64_t count;   // the length of visible_ids from there on (may exceed 32)
  int32_t id;      // the Gaussian of this lane; -1: none
  int warp, lane;  // the warp's index in the block, the lane's in the warp
};

// The gradients of the Gaussians' parameters: those of the splats taken back through the projection, the
// colours and the activations (docs/image.md, sections 4, 2 and 1). One thread per visible Gaussian
// recomputes its splats and sums over them in order. Every thread calls sink.begin() before the block's only
// barrier, and sink.take() and then sink.take_sh() at the end; the sink may use the warp's stages to reorder
// values between lanes.
template <int DEGREE, bool QUADS, class Source, class Sink>
__global__ void __launch_bounds__(kBackwardThreads, 3)
    project_backward_kernel(const __grid_constant__ BackwardInputs<Source> args,
                            const __grid_constant__ Sink sink) {
  using Coefficients = ShRow<DEGREE>;
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ ShStage<DEGREE> stages[QUADS ? kBackwardThreads / 32 : 1];
  __shared__ TripleStage triples[kBackwardThreads / 32];
  __shared__ typename Sink::Shared shared;
  const Inputs& in = args.in;
  const int lane = threadIdx.x % 32;
  ShStage<DEGREE>& stage = stages[QUADS ? threadIdx.x / 32 : 0];
  TripleStage& triple = triples[threadIdx.x / 32];
  const int64_t first = blockIdx.x * int64_t(kBackwardThreads) + threadIdx.x / 32 * 32;
  const int64_t u = first + lane;
  const bool exists = u < args.splats.n_visible;
  const int32_t id = exists ? args.splats.visible_ids[u] : -1,
                begin = exists ? args.splats.splat_offsets[u] : 0,
                end = exists ? args.splats.splat_offsets[u + 1] : 0;
  const int64_t stride = 3 * in.options.sh_stride;
  const bool has_colors = in.sh && args.v.colored();
  if constexpr (QUADS) {
    if (has_colors) stage.gather(in.sh, stride, id, lane);
  }
  // Issue all early loads before the first wait, so that their latencies overlap.
  const int64_t known = id < 0 ? 0 : id;
  const Vec3<float> mean_part = TripleStage::fetch(in.means, id, lane),
                    scale_part = TripleStage::fetch(in.scales, id, lane);
  float quat[4];
  load_quat(in, known, quat);
  const float opacity = in.opacities[known], inverse_reach2 = inverse_reach2_of(in.fade, known);
  GeometryGradient<float> v_splat{};
  int view = 0;
  const auto load_splat = [&](int64_t r) {
    if (r >= end) return;
    view = args.splats.camera_ids[r];
    v_splat = args.v.geometry(r);
  };
  load_splat(begin);
  const WarpRows warp{first, args.splats.n_visible - first, id, int(threadIdx.x) / 32, lane};
  load_cameras(in, cameras);
  auto own = sink.begin(shared, warp);
  __syncthreads();
  const Vec3<float> mean = triple.share(mean_part, lane), scale = triple.share(scale_part, lane);

  Vec3<float> v_mean{}, v_scale{};
  const ActivatedGaussian<float> gaussian =
      activate_gaussian(mean, quat, activate_scale(&scale.x, in.options.raw),
                        activate_opacity(opacity, in.options.raw), inverse_reach2);
  GaussianGradient<float> gradient{};
  float axis_weight = 0.f;
  PoseGradient<float>* no_pose = nullptr;
  for (int64_t r = begin; r < end; ++r) {
    project_splat_vjp(cameras[view], gaussian, in.options, v_splat, &gradient, no_pose);
    if (args.regularisers.scale) axis_weight += args.regularisers.scale[view];
    if (args.regularisers.opacity) gradient.opacity += args.regularisers.opacity[view];
    load_splat(r + 1);
  }

  // The colours come after the geometry, so that the SH coefficients occupy registers only here.
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
    for (int64_t r = begin; r < end; ++r) {
      const Vec3<float> v_color = args.v.color(r);
      splat_color_vjp(cameras[args.splats.camera_ids[r]], mean, sh.values, DEGREE, &v_color.x, v_sh.values,
                      &gradient.mean, no_pose);
    }
  }
  if constexpr (QUADS) stage.write(lane, v_sh);
  float v_quat[4] = {}, v_opacity = 0.f;
  if (id >= 0) {
    activate_gaussian_vjp(gaussian, in.options.raw, gradient, axis_weight,
                          ParameterGradients<float>{&v_mean.x, v_quat, &v_scale.x, &v_opacity});
  }
  sink.take(shared, own, warp, triple, v_mean, {v_quat[0], v_quat[1], v_quat[2], v_quat[3]}, v_scale,
            v_opacity);
  if constexpr (QUADS) {
    sink.take_sh(shared, own, warp, stage);
  } else {
    sink.take_sh(shared, own, warp, v_sh);
  }
}

template <int DEGREE, bool QUADS, class Source, class Sink>
void launch_backward(const BackwardInputs<Source>& args, const Sink& sink, CudaStream stream) {
  const unsigned blocks = blocks_for(args.splats.n_visible, kBackwardThreads);
  project_backward_kernel<DEGREE, QUADS><<<blocks, kBackwardThreads, 0, stream>>>(args, sink);
  check_launch("project_bwd");
}

}  // namespace blitzgs::cuda
