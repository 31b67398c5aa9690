// SPDX-License-Identifier: Apache-2.0
// The exchange of splats between ranks (BlitzGS, section 3.1; Grendel-GS, Zhao et al. 2024): packing and
// unpacking. Bit m of masks[p] sends splat p to rank m; the splats for one rank are a group. All data are
// 32-bit words: a column with w words per splat is int32 [P, w].
//
//   scatter: columns, masks -> one group per rank, in which each column is contiguous; and places [runs, M]:
//            the positions in each group of the splats of each run of kPlaceSplats splats. The splats of a
//            block of kScatterBlock splats keep their order in a group, but blocks may come in any order. The
//            places are all that the sender needs to find its splats' gradients again.
//   gather:  the groups that arrived, one after the other -> columns.
//   sum:     values [S, F] of each group -> columns [P, w], the sum over the groups of each splat in the
//            order of ranks, starting from zero: deterministic. On CUDA the values may be in the memory of
//            the GPUs that composited the splats.
//
// The cost is O(words moved). Splats beyond the given size of a group are dropped, whatever the masks say.
#pragma once
#include "common/kernel.h"

namespace blitzgs {

constexpr int kPlaceSplats = 32;

inline int64_t place_runs(int64_t splats) { return (splats + kPlaceSplats - 1) / kPlaceSplats; }

BLITZGS_HD int count_bits(uint32_t bits) {
#ifdef __CUDA_ARCH__
  return __popc(bits);
#else
  return __builtin_popcount(bits);
#endif
}

// The splats of a run (of kPlaceSplats consecutive ones) that went to one rank. The ops pass it as an int64.
struct alignas(8) SplatPlace {
  int32_t first;  // the position of the first of them in the rank's group
  uint32_t bits;  // bit i: splat i of the run is one of them

  // splat: the index in the run, in [0, kPlaceSplats).
  BLITZGS_HD bool has(uint32_t splat) const { return (bits >> splat) & 1u; }
  BLITZGS_HD int64_t of(uint32_t splat) const { return first + count_bits(bits & ((1u << splat) - 1u)); }
};

constexpr int kScatterBlock = 256;
constexpr int kMaxSplatColumns = 8;

// bits != 0.
BLITZGS_HD int lowest_bit(uint64_t bits) {
#ifdef __CUDA_ARCH__
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}

// The columns of some splats. begin: the offset of each column in a splat, in words; the last entry is the
// number of words in a splat.
template <class Word> struct SplatColumns {
  Word* data[kMaxSplatColumns];
  int begin[kMaxSplatColumns + 1];
  int count;
};

// The number of splats in each of M groups, and the number of splats in the groups before it.
struct SplatGroups {
  int64_t size[kMaxRanks], start[kMaxRanks];
  int count;
};

struct ScatterTargets {
  int32_t* words[kMaxRanks][kMaxSplatColumns];
};

struct ScatterSplats {
  SplatColumns<const int32_t> columns;
  const int64_t* masks;
  int64_t count;
};

// Values of the splats that went to each rank: `size` rows of `width` values.
template <class T> struct SplatValues {
  const T* values[kMaxRanks];
  int64_t size[kMaxRanks];
  int n_ranks, width;
  int64_t count;             // the splats of this rank
  const SplatPlace* places;  // where in each rank's rows they are

  // Calls f(pointer to the splat's values from a rank) for each rank that the splat went to, in order.
  template <class F> BLITZGS_HD void for_each(uint64_t splat, const F& f) const {
    const SplatPlace* run = places + splat / kPlaceSplats * n_ranks;
    const auto in_run = uint32_t(splat % kPlaceSplats);
    uint64_t ranks = 0;
#ifdef __CUDA_ARCH__
#pragma unroll 4  // four loads at a time; the compiler would choose 16
#endif
    for (int m = 0; m < n_ranks; ++m) ranks |= uint64_t{run[m].has(in_run)} << m;
    // Most splats went to a single rank. So the threads of a warp load first values together.
    for (; ranks != 0; ranks &= ranks - 1) {
      const int m = lowest_bit(ranks);
      const int64_t at = run[m].of(in_run);
      if (at < size[m]) f(values[m] + at * width);
    }
  }
};

namespace BLITZGS_BACKEND {
void scatter(const ScatterSplats&, const SplatGroups&, const ScatterTargets&, SplatPlace* places, Workspace&,
             CudaStream);
void gather(const int32_t* packed, const SplatGroups&, const SplatColumns<int32_t>&, CudaStream);
template <class T> void sum(const SplatValues<T>&, const SplatColumns<T>&, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
