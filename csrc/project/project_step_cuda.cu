// SPDX-License-Identifier: Apache-2.0
#include "project/project.h"

#include "adam/lazy_adam_device.cuh"
#include "project/project_bwd_device.cuh"

namespace blitzgs::cuda {
namespace {

constexpr int kPacks = 12;  // packs of four floats in an SH row of degree 3
constexpr int kBatch = 4;   // packs that a lane has in flight

// The sink of project_backward_kernel (project_bwd_device.cuh) that takes the Adam step of the visible
// Gaussians (lazy_adam.h). The gradients stay in registers and shared memory.
struct StepRows {
  struct Shared {
    AdamStep<float> step;
    int32_t ids[kBackwardThreads];
    Decay decays[kBackwardThreads];
  };
  struct Own {
    int32_t behind;  // pending steps by which the moments of this lane's Gaussian must decay first
  };
  AdamArgs<float> adam;

  __device__ Own begin(Shared& shared, const WarpRows& warp) const {
    if (threadIdx.x == kBackwardThreads - 1) shared.step = adam_step_scalars(adam);
    shared.ids[threadIdx.x] = warp.id;
    return {warp.id < 0 ? 0 : adam.step - 1 - adam.moment_step[warp.id]};
  }

  __device__ void take(Shared& shared, const Own& own, const WarpRows& warp, TripleStage& triple,
                       const Vec3<float>& v_mean, const float4& v_quat, const Vec3<float>& v_scale,
                       float v_opacity) const {
    // Initialised, because the compiler would keep on the stack what lanes without a Gaussian left undefined.
    StepPack<0, 1> means[3]{};
    StepPack<1, 4> quat{};
    StepPack<2, 1> scales[3]{};
    StepPack<3, 1> opacity{};
    load_triples(shared, warp, means);
    load_triples(shared, warp, scales);
    if (warp.id >= 0) {
      quat.load(adam.columns[1], warp.id, 0);
      opacity.load(adam.columns[3], warp.id, 0);
    }
    const Decay decay = make_decay(adam, own.behind);
    shared.decays[threadIdx.x] = decay;
    finish_triples(shared, warp, triple, v_mean, means);
    finish_triples(shared, warp, triple, v_scale, scales);
    if (warp.id < 0) return;
    quat.finish(adam.columns[1], shared.step, decay, {{v_quat.x, v_quat.y, v_quat.z, v_quat.w}});
    opacity.finish(adam.columns[3], shared.step, decay, {{v_opacity}});
    adam.last_step[warp.id] = adam.step;
    adam.moment_step[warp.id] = adam.step;
  }

  template <int DEGREE>
  __device__ void take_sh(Shared& shared, const Own&, const WarpRows& warp,
                          const ShStage<DEGREE>& stage) const {
    const AdamColumn<float>& column = adam.columns[4];
#pragma unroll 1
    for (int base = 0; base < kPacks; base += kBatch) {
      StepPack<4, 4> packs[kBatch]{};
#pragma unroll
      for (int b = 0; b < kBatch; ++b) {
        const int at = (base + b) * 32 + warp.lane, local = at / kPacks;
        if (local < warp.count) packs[b].load(column, shared.ids[warp.warp * 32 + local], at % kPacks);
      }
#pragma unroll
      for (int b = 0; b < kBatch; ++b) {
        const int at = (base + b) * 32 + warp.lane, local = at / kPacks, pack = at % kPacks;
        float4 g{};
        if (pack < ShRow<DEGREE>::kQuads) g = stage.quads[local * ShStage<DEGREE>::kPitch + pack];
        if (local < warp.count) {
          packs[b].finish(column, shared.step, shared.decays[warp.warp * 32 + local], {{g.x, g.y, g.z, g.w}});
        }
      }
    }
  }

 private:
  template <int Column>
  __device__ void load_triples(const Shared& shared, const WarpRows& warp,
                               StepPack<Column, 1> (&items)[3]) const {
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + warp.lane;
      if (at < 3 * warp.count) {
        items[i].load(adam.columns[Column], shared.ids[warp.warp * 32 + at / 3], at % 3);
      }
    }
  }
  template <int Column>
  __device__ void finish_triples(const Shared& shared, const WarpRows& warp, TripleStage& triple,
                                 const Vec3<float>& v, StepPack<Column, 1> (&items)[3]) const {
    triple.set(warp.lane, v);
#pragma unroll
    for (int i = 0; i < 3; ++i) {
      const int at = i * 32 + warp.lane;
      if (at < 3 * warp.count) {
        items[i].finish(adam.columns[Column], shared.step, shared.decays[warp.warp * 32 + at / 3],
                        {{triple.values[at]}});
      }
    }
    __syncwarp();
  }
};

bool moves_by_packs(const AdamArgs<float>& adam) {
  if (adam.columns[4].width != 4 * kPacks) return false;
  for (const AdamColumn<float>& column : {adam.columns[1], adam.columns[4]}) {
    for (const float* values : {column.param, column.exp_avg, column.exp_avg_sq}) {
      if (!aligned16(values)) return false;
    }
  }
  return true;
}

}  // namespace

template <>
void project_bwd_step<float>(const Inputs& in, const SplatIndex& splats, const SplatGradientSource<float>& v,
                             const Regularisers<float>& regularisers, AdamArgs<float> adam,
                             Workspace& workspace, CudaStream stream) {
  if (splats.n_visible == 0) return;
  bool done = false;
  if (moves_by_packs(adam)) {
    dispatch_backward(in, splats, v, regularisers, [&](auto degree, auto quads, const auto& args) {
      if constexpr (quads.value) {
        launch_backward<degree.value, true>(args, StepRows{adam}, stream);
        done = true;
      }
    });
  }
  if (done) return;
  // Parameters that are not aligned in whole packs take the two passes one after the other.
  const ProjectGradients<float> gradients = scratch_gradients(splats, adam, workspace);
  project_bwd(in, splats, v, regularisers, gradients, workspace, stream);
  lazy_adam(adam, workspace, stream);
}

}  // namespace blitzgs::cuda
