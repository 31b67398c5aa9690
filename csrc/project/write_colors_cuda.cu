// SPDX-License-Identifier: Apache-2.0
// Compiled without FMA contraction (cmake/cuda.cmake), as write_splats_cuda.cu.
#include "project/prefilter.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kColorThreads = 128, kColorBlocks = 5;  // such blocks fill a multiprocessor
constexpr int kSplatsOfBlock = 2 * kColorThreads;

// Writes the colour of splat i, of Gaussian id (-1: none), and hides the splat if it is not finite; the whole
// warp takes part. sh_slot: where `stage` gathers its SH row.
template <int DEGREE, bool QUADS>
__device__ __forceinline__ void emit_color(const Inputs& in, const Camera<float>& camera,
                                           const Vec3<float>& mean, ShStage<DEGREE>& stage, int sh_slot,
                                           const ProjectOutputs<float>& out, std::int64_t i,
                                           std::int32_t id) {
  bool shown = true;
  if constexpr (QUADS) {
    stage.wait();
    if (id < 0) return;
    ShRow<DEGREE> sh;
    stage.read(sh_slot, &sh);
    shown = splat_color(camera, mean, sh.values, DEGREE, out.colors + 3 * i);
  } else if (id >= 0) {
    shown = splat_color(camera, mean, in.sh + 3 * in.options.sh_stride * std::int64_t{id}, DEGREE,
                        out.colors + 3 * i);
  }
  if (shown) return;
  out.opacities[i] = 0.f;
  reinterpret_cast<int2*>(out.radii)[i] = {0, 0};
  out.tiles_touched[i] = 0;
}

template <int DEGREE, bool QUADS>
__global__ void __launch_bounds__(kColorThreads, kColorBlocks)
    color_kernel(const Inputs in, const ProjectIds ids, const ProjectCapacity capacity,
                 const ProjectOutputs<float> out) {
  __shared__ ShStage<DEGREE> stages[QUADS ? kColorThreads / 32 : 1];
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ TripleStage triples[kColorThreads / 32];
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  ShStage<DEGREE>& stage = stages[QUADS ? warp : 0];
  const std::int64_t n_splats = fitting(capacity).splats, step = gridDim.x * std::int64_t{kSplatsOfBlock};
  const std::int64_t of_block = blockIdx.x * std::int64_t{kSplatsOfBlock};
  if (of_block >= n_splats) return;
  load_cameras(in, cameras);
  __syncthreads();
  for (std::int64_t begin = of_block; begin < n_splats; begin += step) {
#pragma unroll 1
    for (int first = 0; first < kSplatsOfBlock; first += kColorThreads) {
      const std::int64_t i = begin + first + threadIdx.x;
      const std::int32_t id = i < n_splats ? ids.gaussian_ids[i] : -1;
      int sh_slot = 0;
      if constexpr (QUADS) sh_slot = stage.gather(in.sh, 3 * in.options.sh_stride, id, lane);
      const int view = id < 0 ? 0 : ids.camera_ids[i];
      const Vec3<float> mean = triples[warp].gather(in.means, id, lane);
      emit_color<DEGREE, QUADS>(in, cameras[view], mean, stage, sh_slot, out, i, id);
      __syncwarp();
    }
  }
}

}  // namespace

void write_colors(const Inputs& in, const ProjectCapacity& capacity, const ProjectColumns<float>& columns,
                  CudaStream stream) {
  if (capacity.sizes.splats == 0 || !in.sh) return;
  const std::int64_t blocks = (capacity.sizes.splats + kSplatsOfBlock - 1) / kSplatsOfBlock;
  dispatch_sh(in, [&](auto degree, auto quads) {
    color_kernel<degree.value, quads.value><<<static_cast<unsigned>(blocks), kColorThreads, 0, stream>>>(
        in, columns.ids, capacity, columns.values);
  });
  check_launch("project");
}

}  // namespace blitzgs::cuda
