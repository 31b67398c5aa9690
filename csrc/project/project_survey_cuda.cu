// SPDX-License-Identifier: Apache-2.0
// The first kernel of the projection: a quick test of every candidate, from its mean and its largest scale.
#include <algorithm>

#include "common/multiprocessors.h"
#include "project/project_cull.cuh"
#include "project/project_plan.cuh"

namespace blitzgs::cuda {

namespace {

constexpr int kWarps = kSurveyThreads / 32, kMostOfWarp = kMostSurveyed / kWarps;
constexpr int kBlocksPerMultiprocessor = 8;

// The views that may see each of kSurveyBatch candidates first, first + 32, ..., from the mean, then the
// scale.
__device__ void quick_views(const Inputs& in, std::int64_t n_candidates, const Frustum* frusta,
                            std::int64_t first, std::uint32_t* maybe, std::int32_t* ids) {
  Vec3<float> means[kSurveyBatch];
  float norms[kSurveyBatch];
#pragma unroll
  for (int k = 0; k < kSurveyBatch; ++k) {
    const std::int64_t c = first + 32 * k;
    const bool present = c < n_candidates;
    ids[k] = present ? static_cast<std::int32_t>(candidate_id(in, c)) : 0;
    maybe[k] = !present ? 0u : in.active_views ? static_cast<std::uint32_t>(in.active_views[c]) : ~0u;
    if (in.n_views < 32) maybe[k] &= (1u << in.n_views) - 1u;
    means[k] = maybe[k] ? load3(in.means + std::int64_t{3} * ids[k]) : Vec3<float>{0.f, 0.f, 0.f};
    norms[k] = norm1(means[k]);
  }
  for (int view = 0; view < in.n_views; ++view) {
    const Frustum& frustum = frusta[view];
#pragma unroll
    for (int k = 0; k < kSurveyBatch; ++k) {
      if (!may_be_in_depth(frustum, means[k], norms[k])) maybe[k] &= ~(1u << view);
    }
  }
  float scales[kSurveyBatch];
#pragma unroll
  for (int k = 0; k < kSurveyBatch; ++k) scales[k] = maybe[k] ? largest_scale(in, ids[k]) : 0.f;
  for (int view = 0; view < in.n_views; ++view) {
    const Frustum& frustum = frusta[view];
#pragma unroll
    for (int k = 0; k < kSurveyBatch; ++k) {
      if (!may_overlap(frustum, means[k], norms[k], scales[k])) maybe[k] &= ~(1u << view);
    }
  }
}

// A block takes candidates turn by turn; those that some view may see are listed behind those of the turns
// before.
__global__ void __launch_bounds__(kSurveyThreads, kBlocksPerMultiprocessor)
    survey_kernel(const Inputs in, const Plan plan, const RunningSum before) {
  __shared__ Camera<float> cameras[kMaxViews];
  __shared__ Frustum frusta[kMaxViews];
  __shared__ std::uint32_t left_views[kWarps][kMostOfWarp];
  __shared__ std::int32_t left_ids[kWarps][kMostOfWarp];
  __shared__ int left[kWarps];
  const std::int64_t n_candidates = candidates_of(in);
  const int at_once = surveyed_at_once(n_candidates), of_warp = at_once / kWarps;
  const std::int64_t n_turns = (n_candidates + at_once - 1) / at_once;
  if (blockIdx.x == 0 && threadIdx.x == 0 && n_turns == 0) *plan.count = 0;
  if (blockIdx.x >= n_turns) return;
  load_cameras(in, cameras);
  __syncthreads();
  for (int view = threadIdx.x; view < in.n_views; view += kSurveyThreads)
    frusta[view] = make_frustum(cameras[view], in.options);
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const unsigned below = (1u << lane) - 1u;
  for (;;) {
    const int turn = before.take_turn();
    if (turn >= n_turns) return;
    const std::int64_t first = turn * std::int64_t{at_once} + warp * of_warp;
    int n_left = 0;
    for (int batch = 0; batch < of_warp; batch += 32 * kSurveyBatch) {
      std::uint32_t maybe[kSurveyBatch];
      std::int32_t ids[kSurveyBatch];
      quick_views(in, n_candidates, frusta, first + batch + lane, maybe, ids);
#pragma unroll
      for (int k = 0; k < kSurveyBatch; ++k) {
        const unsigned some = __ballot_sync(kFullWarp, maybe[k] != 0);
        if (maybe[k]) {
          const int at = n_left + __popc(some & below);
          left_views[warp][at] = maybe[k];
          left_ids[warp][at] = ids[k];
        }
        n_left += __popc(some);
      }
    }
    if (lane == 0) left[warp] = n_left;
    __syncthreads();
    int at = 0, of_block = 0;
#pragma unroll
    for (int other = 0; other < kWarps; ++other) {
      if (other < warp) at += left[other];
      of_block += left[other];
    }
    const std::int64_t base = before.sum_before<kSurveyThreads>(turn, of_block);
    if (turn == n_turns - 1 && threadIdx.x == 0) *plan.count = base + of_block;
    for (int i = lane; i < n_left; i += 32) {
      plan.views[base + at + i] = left_views[warp][i];
      plan.ids[base + at + i] = left_ids[warp][i];
    }
  }
}

}  // namespace

std::size_t project_plan_bytes(std::int64_t candidates) {
  return sizeof(std::int64_t) +
         static_cast<std::size_t>(candidates) * (sizeof(std::uint32_t) + sizeof(std::int32_t));
}

void project_survey(const Inputs& in, void* plan_memory, Workspace& workspace, CudaStream stream) {
  const Plan plan(plan_memory, in.n_candidates);
  const std::int64_t turns = in.n_views > 0 ? most_survey_turns(in.n_candidates) : 0;
  if (turns == 0) {
    check(cudaMemsetAsync(plan.count, 0, sizeof(*plan.count), stream), "project_survey");
    return;
  }
  const std::int64_t blocks = std::min<std::int64_t>(turns, kBlocksPerMultiprocessor * multiprocessors());
  auto* zeros = turn_zeros(turns, workspace, stream);
  survey_kernel<<<static_cast<unsigned>(blocks), kSurveyThreads, 0, stream>>>(in, plan, RunningSum(zeros));
  check_launch("project_survey");
}

}  // namespace blitzgs::cuda
