// SPDX-License-Identifier: Apache-2.0
// Splats on their way between ranks. Bit m of masks[p] sends splat p to rank m; the splats for one rank are a
// group. All data are 32-bit words: a column of w words a splat is int32 [P, w].
//
//   scatter: columns, masks -> one group per rank, each column of a group consecutive; and places [runs, M]:
//            where in each group the splats of each run of kPlaceSplats splats are. Within a block of
//            kScatterBlock splats they keep their order; blocks may come in any order, so this is all that
//            the way back needs.
//   gather:  groups that arrived, one after the other -> columns.
//   sum:     values [S, F], groups in the layout of `scatter` one after the other -> columns [P, w], the sum
//            over the groups of each splat in the order of ranks, starting from zero: deterministic.
//
// O(words moved). Splats beyond a group's announced size are dropped, whatever the masks say.
#pragma once
#include <cstdint>

#include "common/kernel.h"
#include "math/tiles.h"

namespace blitzgs {

constexpr int kScatterBlock = 256;
constexpr int kPlaceSplats = 32;
constexpr int kMaxSplatColumns = 8;

inline std::int64_t scatter_blocks(std::int64_t splats) {
  return (splats + kScatterBlock - 1) / kScatterBlock;
}

inline std::int64_t place_runs(std::int64_t splats) { return (splats + kPlaceSplats - 1) / kPlaceSplats; }

BLITZGS_HD int count_bits(std::uint32_t bits) {
#ifdef __CUDA_ARCH__
  return __popc(bits);
#else
  return __builtin_popcount(bits);
#endif
}

// bits != 0.
BLITZGS_HD int lowest_bit(std::uint64_t bits) {
#ifdef __CUDA_ARCH__
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}

// The splats of a run that went to one rank: where the first of them is among the rank's, and which they are.
// The ops pass it as an int64.
struct alignas(8) SplatPlace {
  std::int32_t first;
  std::uint32_t bits;

  // splat: of the run, in [0, kPlaceSplats).
  BLITZGS_HD bool has(std::uint32_t splat) const { return (bits >> splat) & 1u; }
  BLITZGS_HD std::int64_t of(std::uint32_t splat) const {
    return first + count_bits(bits & ((1u << splat) - 1u));
  }
};

// Columns of one table, and where each begins in a splat of all of them; the last begin is the splat's
// length.
template <class Word>
struct SplatColumns {
  Word* data[kMaxSplatColumns];
  int begin[kMaxSplatColumns + 1];
  int count;
};

// Splats of each group and the splats before it; M groups.
struct SplatGroups {
  std::int64_t size[kMaxRanks], start[kMaxRanks];
  int count;
};

// Where each column of each rank's group begins.
struct ScatterTargets {
  std::int32_t* words[kMaxRanks][kMaxSplatColumns];
};

// The splats to scatter.
struct ScatterSplats {
  SplatColumns<const std::int32_t> columns;
  const std::int64_t* masks;
  std::int64_t count;
};

// Values of splats, `width` apart, that came back from each rank that a splat went to.
template <class T>
struct SplatValues {
  const T* values;
  int width;
  std::int64_t count;
  const SplatPlace* places;
  SplatGroups groups;

  // Calls f(pointer to a splat's values), for each rank in order.
  template <class F>
  BLITZGS_HD void for_each(std::uint64_t splat, const F& f) const {
    const SplatPlace* run = places + splat / kPlaceSplats * groups.count;
    const auto in_run = static_cast<std::uint32_t>(splat % kPlaceSplats);
    std::uint64_t ranks = 0;
#ifdef __CUDA_ARCH__
#pragma unroll 4  // as many loads at once; the compiler's own choice is 16
#endif
    for (int m = 0; m < groups.count; ++m) ranks |= std::uint64_t{run[m].has(in_run)} << m;
    // Most splats went to a single rank: this way the threads of a warp load their first at once.
    for (; ranks != 0; ranks &= ranks - 1) {
      const int m = lowest_bit(ranks);
      const std::int64_t at = run[m].of(in_run);
      if (at < groups.size[m]) f(values + (groups.start[m] + at) * width);
    }
  }
};

namespace cpu {
void scatter(const ScatterSplats&, const SplatGroups&, const ScatterTargets&, SplatPlace* places, Workspace&,
             CudaStream);
void gather(const std::int32_t* packed, const SplatGroups&, const SplatColumns<std::int32_t>&, Workspace&,
            CudaStream);
template <class T>
void sum(const SplatValues<T>&, const SplatColumns<T>&, Workspace&, CudaStream);
}  // namespace cpu

namespace cuda {
void scatter(const ScatterSplats&, const SplatGroups&, const ScatterTargets&, SplatPlace* places, Workspace&,
             CudaStream);
void gather(const std::int32_t* packed, const SplatGroups&, const SplatColumns<std::int32_t>&, Workspace&,
            CudaStream);
template <class T>
void sum(const SplatValues<T>&, const SplatColumns<T>&, Workspace&, CudaStream);
}  // namespace cuda

}  // namespace blitzgs
