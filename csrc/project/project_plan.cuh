// SPDX-License-Identifier: Apache-2.0
// What counting hands to emitting: for each segment of candidates, which of them are visible.
#pragma once
#include "project/project_device.cuh"

namespace blitzgs::cuda {

// Candidates that a warp takes together: as many as leave enough of them to fill the device.
inline constexpr int kMostSegment = 512, kLeastSegment = 128;
inline constexpr std::int64_t kSegmentsWanted = 1 << 14;

__host__ __device__ inline int segment_of(std::int64_t candidates) {
  int segment = kMostSegment;
  while (segment > kLeastSegment && candidates < kSegmentsWanted * segment) segment /= 2;
  return segment;
}

__host__ __device__ inline std::int64_t segments_of(std::int64_t candidates) {
  return (candidates + segment_of(candidates) - 1) / segment_of(candidates);
}

// The most segments that so many candidates, or fewer, can have.
__host__ __device__ inline std::int64_t most_segments(std::int64_t candidates) {
  const std::int64_t in_small = (candidates + kLeastSegment - 1) / kLeastSegment,
                     in_large = (candidates + kMostSegment - 1) / kMostSegment,
                     wanted = 2 * kSegmentsWanted;  // beyond, segments double
  return in_small < wanted ? in_small : in_large > wanted ? in_large : wanted;
}

// How many candidates there are.
__device__ inline std::int64_t candidates_of(const Inputs& in) {
  return in.n_active ? *in.n_active : in.n_candidates;
}

// What is to be written: nothing where it does not fit.
__device__ inline ProjectSizes fitting(const ProjectRoom& room) {
  const ProjectSizes sizes{room.totals[kTotalVisible], room.totals[kTotalRows]};
  return sizes.visible <= room.sizes.visible && sizes.rows <= room.sizes.rows ? sizes : ProjectSizes{0, 0};
}

__device__ inline std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

// Visible candidates and rows in one number, so that one scan serves both.
__device__ inline std::int64_t pack_counts(std::int64_t visible, std::int64_t rows) {
  return visible << 32 | rows;
}

// before [most_segments + 1]: pack_counts() of the segments before each. The visible candidates of segment s
// are the first entries from segment_of() * s on, ascending: the views that see each, and where in the
// segment it is.
template <class Count, class Views, class Slot>
struct Plan {
  Count* before;
  Views* views;
  Slot* slots;

  template <class Memory>
  Plan(Memory* memory, std::int64_t candidates)
      : before(static_cast<Count*>(memory)),
        views(reinterpret_cast<Views*>(before + most_segments(candidates) + 1)),
        slots(reinterpret_cast<Slot*>(views + candidates)) {}
};
using NewPlan = Plan<std::int64_t, std::uint32_t, std::uint16_t>;
using MadePlan = Plan<const std::int64_t, const std::uint32_t, const std::uint16_t>;

}  // namespace blitzgs::cuda
