// SPDX-License-Identifier: Apache-2.0
// Limits that several ops share, each defined here alone.
#pragma once

namespace blitzgs {

inline constexpr int kMaxViews = 32;   // views of one launch: an int32 holds a bit for each
inline constexpr int kMaxRanks = 63;   // ranks of a job: a non-negative int64 holds a bit for each
inline constexpr int kMaxLevels = 32;  // octree levels
inline constexpr int kMaxPeers = 16;   // ranks that write to each other's memory

}  // namespace blitzgs
