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

__device__ inline std::int64_t candidate_id(const Inputs& in, std::int64_t candidate) {
  return in.active_ids ? in.active_ids[candidate] : candidate;
}

// Visible candidates and rows in one number, so that one scan serves both.
__device__ inline std::int64_t pack_counts(std::int64_t visible, std::int64_t rows) {
  return visible << 32 | rows;
}

// before [segments + 1]: pack_counts() of the segments before each. The visible candidates of segment s are
// the first entries from segment_of() * s on, ascending: the views that see each, and where in the segment it
// is.
template <class Count, class Views, class Slot>
struct Plan {
  Count* before;
  Views* views;
  Slot* slots;

  template <class Memory>
  Plan(Memory* memory, std::int64_t candidates)
      : before(static_cast<Count*>(memory)),
        views(reinterpret_cast<Views*>(before + segments_of(candidates) + 1)),
        slots(reinterpret_cast<Slot*>(views + candidates)) {}
};
using NewPlan = Plan<std::int64_t, std::uint32_t, std::uint16_t>;
using MadePlan = Plan<const std::int64_t, const std::uint32_t, const std::uint16_t>;

}  // namespace blitzgs::cuda
