// SPDX-License-Identifier: Apache-2.0
// What the three kernels of the projection share: the prefilter hands the Gaussians that some view may see to
// the kernel that projects them and writes splats, and that hands the splats to the kernel of the colours.
#pragma once
#include "common/turn_sums.cuh"
#include "project/project_device.cuh"

namespace blitzgs::cuda {

// Candidates that a block of the prefilter takes at a time: as many as leave enough of them to fill the
// device.
inline constexpr int kPrefilterThreads = 128, kPrefilterBatch = 4;
inline constexpr int kLeastAtOnce = kPrefilterThreads * kPrefilterBatch, kMostAtOnce = 4 * kLeastAtOnce;
inline constexpr std::int64_t kTurnsWanted = 1 << 12;

__host__ __device__ inline int prefiltered_at_once(std::int64_t candidates) {
  int count = kMostAtOnce;
  while (count > kLeastAtOnce && candidates < kTurnsWanted * count) count /= 2;
  return count;
}

// The most turns that so many candidates, or fewer, can take.
inline std::int64_t most_prefilter_turns(std::int64_t candidates) {
  const std::int64_t in_small = (candidates + kLeastAtOnce - 1) / kLeastAtOnce,
                     in_large = (candidates + kMostAtOnce - 1) / kMostAtOnce;
  return in_small < 2 * kTurnsWanted ? in_small : in_large > 2 * kTurnsWanted ? in_large : 2 * kTurnsWanted;
}

// Gaussians that a block projects at a time, a thread each at first, and the most pairs of one and a view
// that these make.
inline constexpr int kSplatThreads = 128, kMostPairs = 512;

__host__ __device__ inline int projected_at_once(int n_views) {
  return n_views > kMostPairs / kSplatThreads ? kMostPairs / n_views : kSplatThreads;
}

// For a RunningSum over so many turns, or their TurnSums.
inline std::uint64_t* turn_zeros(std::int64_t turns, Workspace& workspace, CudaStream stream) {
  const std::int64_t count = turns + 1;
  auto* zeros = workspace.allocate<std::uint64_t>(count);
  check(cudaMemsetAsync(zeros, 0, count * sizeof(*zeros), stream), "project");
  return zeros;
}

// How many candidates there are.
__device__ inline std::int64_t candidates_of(const Inputs& in) {
  return in.n_active ? *in.n_active : in.n_candidates;
}

__device__ inline std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

// What is to be read of splats that write_splats had room for: nothing where they did not fit.
__device__ inline ProjectSizes fitting(const ProjectCapacity& capacity) {
  if (!capacity.totals) return capacity.sizes;
  const ProjectSizes sizes{capacity.totals[kTotalVisible], capacity.totals[kTotalSplats]};
  return sizes.visible <= capacity.sizes.visible && sizes.splats <= capacity.sizes.splats
             ? sizes
             : ProjectSizes{0, 0};
}

// The Gaussians that some views may see, in the order of the candidates, and these views as bits:
// count [1], ids and views [candidates].
struct Prefiltered {
  std::int64_t* count;
  std::uint32_t* views;
  std::int32_t* ids;

  Prefiltered(std::int64_t candidates, Workspace& workspace) {
    constexpr std::int64_t kEach = sizeof(std::uint32_t) + sizeof(std::int32_t);
    count = static_cast<std::int64_t*>(workspace.allocate_bytes(sizeof(std::int64_t) + candidates * kEach));
    views = reinterpret_cast<std::uint32_t*>(count + 1);
    ids = reinterpret_cast<std::int32_t*>(views + candidates);
  }
};

void prefilter(const Inputs&, const Prefiltered&, Workspace&, CudaStream);
// totals: null, where they are known. With no room splats are counted only.
void write_splats(const Inputs&, const RankTiles&, const Prefiltered&, const ProjectSizes& capacity,
                  const ProjectColumns<float>&, std::int64_t* totals, Workspace&, CudaStream);
// Of the splats that write_splats wrote; none without sh.
void write_colors(const Inputs&, const ProjectCapacity&, const ProjectColumns<float>&, CudaStream);

}  // namespace blitzgs::cuda
