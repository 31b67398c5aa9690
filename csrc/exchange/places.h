// SPDX-License-Identifier: Apache-2.0
// scatter.h copies each splat to the ranks that composite it. Places tell where they went: a SplatPlace,
// [runs, M], has for a run of kPlaceSplats consecutive splats and one rank which of them the rank got, and
// where they begin among all that it got.
#pragma once
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

constexpr int kPlaceSplats = 32;

inline std::int64_t place_runs(std::int64_t splats) { return (splats + kPlaceSplats - 1) / kPlaceSplats; }

BLITZGS_HD int count_bits(std::uint32_t bits) {
#ifdef __CUDA_ARCH__
  return __popc(bits);
#else
  return __builtin_popcount(bits);
#endif
}

// The splats of a run that went to one rank. The ops pass it as an int64.
struct alignas(8) SplatPlace {
  std::int32_t first;  // the position of the first of them in the rank's group
  std::uint32_t bits;  // bit i: splat i of the run is one of them

  // splat: the index in the run, in [0, kPlaceSplats).
  BLITZGS_HD bool has(std::uint32_t splat) const { return (bits >> splat) & 1u; }
  BLITZGS_HD std::int64_t of(std::uint32_t splat) const {
    return first + count_bits(bits & ((1u << splat) - 1u));
  }
};

}  // namespace blitzgs
