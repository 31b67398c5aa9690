// SPDX-License-Identifier: Apache-2.0
// The projection on CUDA: the prefilter of all candidates (kernel 1 of project.h), the colours of the splats
// (kernel 3), and project(), which queues the three kernels. Compiled without FMA contraction
// (cmake/cuda.cmake), as write_splats_cuda.cu.
#include "common/rows.h"
#include "math/frustum.h"
#include "project/project_device.cuh"
#include "project/unscented.h"

namespace blitzgs::cuda {
namespace {

constexpr int kWarps = kPrefilterThreads / 32, kMaxWarpCandidates = kMaxAtOnce / kWarps;
constexpr int kBlocksPerMultiprocessor = 8;

// Not inlined: the double-precision values in here would make the kernel's loop spill registers.
__device__ __noinline__ void store_frustum(const Camera<float>* camera, int width, int height,
                                           float near_plane, float far_plane, float eps2d, Frustum* frustum) {
  *frustum = make_frustum(*camera, width, height, near_plane, far_plane, eps2d);
}

// An upper bound on the Gaussian's largest scale, for may_overlap, which assumes an opacity of at most 1: for
// a larger one, which only a stored opacity can have, the scale counts as unbounded. A stored scale may be
// negative; the Gaussian is that of its absolute value.
__device__ float largest_scale(const Inputs& in, int64_t id) {
  const float* s = in.scales + 3 * id;
  if (in.options.raw) return 1.001f * __expf(fmaxf(s[0], fmaxf(s[1], s[2])));
  const float widest = fmaxf(fabsf(s[0]), fmaxf(fabsf(s[1]), fabsf(s[2])));
  return in.opacities[id] <= 1.f ? widest : kAnyWidth;
}

// Finds the views that may see each of the kPrefilterBatch candidates first, first + 32, ...: from their
// means, then, if some view still may see it, from their scales. Writes these views, as bits, and ids.
__device__ void quick_views(const Inputs& in, int64_t n_candidates, const Frustum* frusta, int64_t first,
                            uint32_t* maybe, int32_t* ids) {
  Vec3<float> means[kPrefilterBatch];
  float norms[kPrefilterBatch];
#pragma unroll
  for (int k = 0; k < kPrefilterBatch; ++k) {
    const int64_t c = first + 32 * k;
    const bool present = c < n_candidates;
    ids[k] = present ? int32_t(in.candidate_id(c)) : 0;
    maybe[k] = !present ? 0u : in.active_views ? uint32_t(in.active_views[c]) : ~0u;
    if (in.n_views < 32) maybe[k] &= (1u << in.n_views) - 1u;
    means[k] = maybe[k] ? load3(in.means + int64_t{3} * ids[k]) : Vec3<float>{0.f, 0.f, 0.f};
    norms[k] = norm1(means[k]);
  }
  for (int view = 0; view < in.n_views; ++view) {
    const Frustum& frustum = frusta[view];
#pragma unroll
    for (int k = 0; k < kPrefilterBatch; ++k) {
      if (!may_be_in_depth(frustum, means[k], norms[k])) maybe[k] &= ~(1u << view);
    }
  }
  float scales[kPrefilterBatch];
#pragma unroll
  for (int k = 0; k < kPrefilterBatch; ++k) scales[k] = maybe[k] ? largest_scale(in, ids[k]) : 0.f;
  for (int view = 0; view < in.n_views; ++view) {
    const Frustum& frustum = frusta[view];
#pragma unroll
    for (int k = 0; k < kPrefilterBatch; ++k) {
      if (!may_overlap(frustum, means[k], norms[k], scales[k])) maybe[k] &= ~(1u << view);
    }
  }
}

// Lists the candidates that some view may see, in order, in `kept`: the Gaussians and those views as bits. A
// block takes batches of candidates (turns) until none is left; each thread tests kPrefilterBatch candidates
// at a time. `before` (RunningSum, common/cuda.cuh) gives the length of the list before each turn.
__global__ void __launch_bounds__(kPrefilterThreads, kBlocksPerMultiprocessor)
    prefilter_kernel(const Inputs in, const Prefiltered kept, const RunningSum before) {
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ Frustum frusta[kMaxViews];
  __shared__ uint32_t listed_views[kWarps][kMaxWarpCandidates];
  __shared__ int32_t listed_ids[kWarps][kMaxWarpCandidates];
  __shared__ int listed_by_warp[kWarps];
  const int64_t n_candidates = candidates_of(in);
  const int at_once = prefiltered_at_once(n_candidates), warp_candidates = at_once / kWarps;
  const int64_t n_turns = (n_candidates + at_once - 1) / at_once;
  if (blockIdx.x == 0 && threadIdx.x == 0 && n_turns == 0) *kept.count = 0;
  if (blockIdx.x >= n_turns) return;
  load_cameras(in, cameras);
  __syncthreads();
  for (int view = threadIdx.x; view < in.n_views; view += kPrefilterThreads)
    store_frustum(cameras + view, in.options.width, in.options.height, in.options.near_plane,
                  in.options.far_plane, in.options.eps2d, frusta + view);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const unsigned below = (1u << lane) - 1u;
  for (;;) {
    const int turn = before.take_turn();
    if (turn >= n_turns) return;
    const int64_t first = turn * int64_t{at_once} + warp * warp_candidates;
    int n_listed = 0;
    for (int batch = 0; batch < warp_candidates; batch += 32 * kPrefilterBatch) {
      uint32_t maybe[kPrefilterBatch];
      int32_t ids[kPrefilterBatch];
      quick_views(in, n_candidates, frusta, first + batch + lane, maybe, ids);
#pragma unroll
      for (int k = 0; k < kPrefilterBatch; ++k) {
        const unsigned some = __ballot_sync(kFullWarp, maybe[k] != 0);
        if (maybe[k]) {
          const int at = n_listed + __popc(some & below);
          listed_views[warp][at] = maybe[k];
          listed_ids[warp][at] = ids[k];
        }
        n_listed += __popc(some);
      }
    }
    if (lane == 0) listed_by_warp[warp] = n_listed;
    __syncthreads();
    int at = 0, listed_by_block = 0;
#pragma unroll
    for (int other = 0; other < kWarps; ++other) {
      if (other < warp) at += listed_by_warp[other];
      listed_by_block += listed_by_warp[other];
    }
    const int64_t base = before.sum_before<kPrefilterThreads>(turn, listed_by_block);
    if (turn == n_turns - 1 && threadIdx.x == 0) *kept.count = base + listed_by_block;
    for (int i = lane; i < n_listed; i += 32) {
      kept.views[base + at + i] = listed_views[warp][i];
      kept.ids[base + at + i] = listed_ids[warp][i];
    }
  }
}

constexpr int kColorThreads = 128, kColorBlocks = 5;  // kColorBlocks: the blocks that fit a multiprocessor
constexpr int kSplatsOfBlock = 2 * kColorThreads;

// Writes the colour of splat i, of Gaussian id (-1: none), and hides the splat if its colour is not finite.
// All lanes of the warp must call this. sh_slot: the slot of `stage` that holds the Gaussian's SH row.
template <int DEGREE, bool QUADS>
__device__ __forceinline__ void emit_color(const Inputs& in, const Camera<float>& camera,
                                           const Vec3<float>& mean, ShStage<DEGREE>& stage, int sh_slot,
                                           const ProjectOutputs<float>& out, int64_t i, int32_t id) {
  bool shown = true;
  if constexpr (QUADS) {
    stage.wait();
    if (id < 0) return;
    ShRow<DEGREE> sh;
    stage.read(sh_slot, &sh);
    shown = splat_color(camera, mean, sh.values, DEGREE, out.colors + 3 * i);
  } else if (id >= 0) {
    shown =
        splat_color(camera, mean, in.sh + 3 * in.options.sh_stride * int64_t{id}, DEGREE, out.colors + 3 * i);
  }
  if (shown) return;
  out.opacities[i] = 0.f;
  reinterpret_cast<int2*>(out.radii)[i] = {0, 0};
  out.tiles_touched[i] = 0;
}

// The colour of each splat (docs/image.md, section 4), to out.colors [P, 3]. One thread per splat, 256 splats
// per block. The warp gathers SH rows and means through shared memory. Does nothing if the splats exceeded
// the capacity.
template <int DEGREE, bool QUADS>
__global__ void __launch_bounds__(kColorThreads, kColorBlocks)
    color_kernel(const Inputs in, const ProjectIds ids, const ProjectCapacity capacity,
                 const ProjectOutputs<float> out) {
  __shared__ ShStage<DEGREE> stages[QUADS ? kColorThreads / 32 : 1];
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ TripleStage triples[kColorThreads / 32];
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  ShStage<DEGREE>& stage = stages[QUADS ? warp : 0];
  const int64_t n_splats = capacity.fitting().splats, step = gridDim.x * int64_t{kSplatsOfBlock};
  const int64_t block_start = blockIdx.x * int64_t{kSplatsOfBlock};
  if (block_start >= n_splats) return;
  load_cameras(in, cameras);
  __syncthreads();
  for (int64_t begin = block_start; begin < n_splats; begin += step) {
#pragma unroll 1
    for (int first = 0; first < kSplatsOfBlock; first += kColorThreads) {
      const int64_t i = begin + first + threadIdx.x;
      const int32_t id = i < n_splats ? ids.gaussian_ids[i] : -1;
      int sh_slot = 0;
      if constexpr (QUADS) sh_slot = stage.gather(in.sh, 3 * in.options.sh_stride, id, lane);
      const int view = id < 0 ? 0 : ids.camera_ids[i];
      const Vec3<float> mean = triples[warp].gather(in.means, id, lane);
      emit_color<DEGREE, QUADS>(in, cameras[view], mean, stage, sh_slot, out, i, id);
      __syncwarp();
    }
  }
}

void prefilter(const Inputs& in, const Prefiltered& kept, Workspace& workspace, CudaStream stream) {
  const int64_t turns = in.n_views > 0 ? most_prefilter_turns(in.n_candidates) : 0;
  if (turns == 0) {
    check(cudaMemsetAsync(kept.count, 0, sizeof(*kept.count), stream), "project");
    return;
  }
  prefilter_kernel<<<resident_blocks(turns, 1, kBlocksPerMultiprocessor), kPrefilterThreads, 0, stream>>>(
      in, kept, RunningSum(turn_zeros(turns, workspace, stream)));
  check_launch("project");
}

}  // namespace

template <>
void color_splats<float>(const Inputs& in, const ProjectCapacity& capacity,
                         const ProjectColumns<float>& columns, CudaStream stream) {
  if (capacity.sizes.splats == 0 || !in.sh) return;
  const unsigned blocks = blocks_for(capacity.sizes.splats, kSplatsOfBlock);
  dispatch_sh(in, [&](auto degree, auto quads) {
    color_kernel<degree.value, quads.value>
        <<<blocks, kColorThreads, 0, stream>>>(in, columns.ids, capacity, columns.values);
  });
  check_launch("project");
}

template <>
void project<float>(const Inputs& in, const RankTiles& rank_tiles, const ProjectSizes* capacity,
                    const SplatMemory<float>& memory, int64_t* totals, Workspace& workspace,
                    CudaStream stream) {
  const Prefiltered kept(in.n_candidates, workspace);
  prefilter(in, kept, workspace, stream);
  if (capacity) {
    const ProjectColumns<float> columns = memory(*capacity);
    write_splats(in, rank_tiles, kept, *capacity, columns, totals, workspace, stream);
    color_splats(in, {*capacity, totals}, columns, stream);
    return;
  }
  write_splats(in, rank_tiles, kept, {0, 0}, {}, totals, workspace, stream);
  static_assert(kTotalVisible == 0 && kTotalSplats == 1);
  const auto sizes = read_back("project", reinterpret_cast<const ProjectSizes*>(totals), stream);
  const ProjectColumns<float> columns = memory(sizes);
  write_splats(in, rank_tiles, kept, sizes, columns, nullptr, workspace, stream);
  color_splats(in, {sizes, nullptr}, columns, stream);
}

// The unscented projection.
template void for_each_row(const UnscentedVisible<float>&, CudaStream);
template void for_each_row(const UnscentedSplats<float>&, CudaStream);
template void for_each_row(const UnscentedGradients<float>&, CudaStream);

}  // namespace blitzgs::cuda
