// SPDX-License-Identifier: Apache-2.0
// The projection's backward pass on CUDA, whatever becomes of the gradients.
#pragma once
#include "project/project_device.cuh"
#include "project/splat_gradient_reader.cuh"

namespace blitzgs::cuda {

constexpr int kBackwardThreads = 128;

// v: one of SplatGradientSource.
template <class Source>
struct BackwardInputs {
  Inputs in;
  SplatIndex splats;
  Source v;
  Regularisers<float> regularisers;
};

// Calls f(degree, quads, BackwardInputs) with degree and quads as dispatch_sh has them.
template <class F>
void dispatch_backward(const Inputs& in, const SplatIndex& splats, const SplatGradientSource& v,
                       const Regularisers<float>& regularisers, const F& f) {
  std::visit(
      [&](const auto& source) {
        const BackwardInputs<std::decay_t<decltype(source)>> args{in, splats, source, regularisers};
        dispatch_sh(in, [&](auto degree, auto quads) { f(degree, quads, args); });
      },
      v);
}

// A warp's visible Gaussians, a lane each.
struct WarpRows {
  std::int64_t first, count;  // position of the first in the list; how many positions are left from there
  std::int32_t id;            // the lane's own; -1: none
  int warp, lane;
};

// A thread is a visible Gaussian. Its gradients go to the sink: begin() is called by every thread before the
// block meets, take() and then take_sh() at the end, with the warp's stages to reorder them in.
template <int DEGREE, bool QUADS, class Source, class Sink>
__global__ void __launch_bounds__(kBackwardThreads, 3)
    backward_kernel(const __grid_constant__ BackwardInputs<Source> args, const __grid_constant__ Sink sink) {
  using Coefficients = ShRow<DEGREE>;
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ ShStage<DEGREE> stages[QUADS ? kBackwardThreads / 32 : 1];
  __shared__ TripleStage triples[kBackwardThreads / 32];
  __shared__ typename Sink::Shared shared;
  extern __shared__ float4 pulled[];
  const Inputs& in = args.in;
  const int lane = threadIdx.x % 32;
  ShStage<DEGREE>& stage = stages[QUADS ? threadIdx.x / 32 : 0];
  TripleStage& triple = triples[threadIdx.x / 32];
  const std::int64_t first = blockIdx.x * static_cast<std::int64_t>(kBackwardThreads) + threadIdx.x / 32 * 32;
  const std::int64_t u = first + lane;
  const bool exists = u < args.splats.n_visible;
  const std::int32_t id = exists ? args.splats.visible_ids[u] : -1,
                     begin = exists ? args.splats.splat_offsets[u] : 0,
                     end = exists ? args.splats.splat_offsets[u + 1] : 0;
  const std::int64_t stride = 3 * in.options.sh_stride;
  const bool has_colors = in.sh && args.v.colored();
  using Reader = SplatGradientReader<Source>;
  Reader reader(args.v, pulled, in.n_views);
  if constexpr (QUADS) {
    if (has_colors) stage.gather(in.sh, stride, id, lane);
  }
  // Everything that is needed first is loaded before anything is waited for.
  const std::int64_t known = id < 0 ? 0 : id;
  const Vec3<float> mean_part = TripleStage::fetch(in.means, id, lane),
                    scale_part = TripleStage::fetch(in.scales, id, lane);
  float quat[4];
  load_quat(in, known, quat);
  const float opacity = in.opacities[known], inverse_reach2 = inverse_reach2_of(in.fade, known);
  GeometryGradient<float> v_splat{};
  int view = 0;
  const auto load_splat = [&](std::int64_t r) {
    if (r >= end) return;
    view = args.splats.camera_ids[r];
    if constexpr (!Reader::kPulls) v_splat = args.v.geometry(r);
  };
  load_splat(begin);
  const WarpRows warp{first, args.splats.n_visible - first, id, static_cast<int>(threadIdx.x) / 32, lane};
  reader.pull(begin, end);
  load_cameras(in, cameras);
  auto own = sink.begin(shared, warp);
  __syncthreads();
  const Vec3<float> mean = triple.share(mean_part, lane), scale = triple.share(scale_part, lane);

  Vec3<float> v_mean{}, v_scale{};
  const ActiveGaussian<float> gaussian =
      activate_gaussian(mean, quat, activate_scale(&scale.x, in.options.raw),
                        activate_opacity(opacity, in.options.raw), inverse_reach2);
  GaussianGradient<float> gradient{};
  float axis_weight = 0.f;
  PoseGradient<float>* no_pose = nullptr;
  reader.finish_pull(begin, end);
  reader.for_each(begin, end, [&](std::int64_t r, const auto& v) {
    if constexpr (Reader::kPulls) v_splat = v.geometry(r);
    project_splat_vjp(cameras[view], gaussian, in.options, v_splat, &gradient, no_pose);
    if (args.regularisers.scale) axis_weight += args.regularisers.scale[view];
    if (args.regularisers.opacity) gradient.opacity += args.regularisers.opacity[view];
    load_splat(r + 1);
  });

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
    reader.for_each(begin, end, [&](std::int64_t r, const auto& v) {
      const Vec3<float> v_color = v.color(r);
      splat_color_vjp(cameras[args.splats.camera_ids[r]], mean, sh.values, DEGREE, &v_color.x, v_sh.values,
                      &gradient.mean, no_pose);
    });
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
  const auto kernel = backward_kernel<DEGREE, QUADS, Source, Sink>;
  const std::size_t bytes =
      SplatGradientReader<Source>::shared_bytes(args.v, args.in.n_views, kBackwardThreads / 32);
  if (bytes > 0) {
    check(cudaFuncSetAttribute(kernel, cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(bytes)),
          "project_bwd");
  }
  const unsigned blocks = blocks_for(args.splats.n_visible, kBackwardThreads);
  kernel<<<blocks, kBackwardThreads, bytes, stream>>>(args, sink);
  check_launch("project_bwd");
}

}  // namespace blitzgs::cuda
