// SPDX-License-Identifier: Apache-2.0
// The contributions of splats to the image, for the importance pass (BlitzGS, section 3.2), by the
// compositing of rasterize/rasterize.h. The sums of a splat are over the pixels at which it is composited:
//   weights = sum of u, u = round(2^32 alpha T)   int64 [P], u to the nearest integer, ties to even
//   pixels  = number of these pixels              int32 [P]
//   squares = sum of floor(u^2 / 2^32)            int64 [P], which is (alpha T)^2 in the same units; optional
//
//   means2d [P, 2], conics [P, 3], opacities [P], isect_splats and tile_offsets from intersect  ->  the sums
//   over the tiles [tile_begin, tile_end). Splats in no list get zeros.
//
// The sums are exact: alpha T of a pixel has the bits with which the backend renders the pixel (with the same
// tile size), and the sums are integers, so tile ranges, ranks, threads and atomics change no bit. An alpha T
// is at least 1e-4 / 255, so never rounded to zero, and below 1, so a sum over 2^31 pixels fits. CPU and CUDA
// agree to the rounding of alpha. The cost is O(entries processed x pixels of the splat).
#pragma once
#include "rasterize/rasterize.h"

namespace blitzgs {

inline constexpr int64_t kContributionScale = int64_t{1} << 32;  // the number of units in 1

struct ContributionSums {
  int64_t* weights;
  int32_t* pixels;
  int64_t* squares;  // null: not wanted
};

namespace BLITZGS_BACKEND {
template <class T>
void contributions(const RasterizeInput<T>& in, const ContributionSums& sums, Workspace&, CudaStream);
}  // namespace BLITZGS_BACKEND

// The sums of the importance sweep (BlitzGS, section 3.2: the score s, c_rad, c_vis and the cull matrix) for
// a batch of at most kMaxViews views. For each visible Gaussian g the op adds over its consecutive splats i
// (g in the view v_i):
//
//   score[g]   += round(w / (a + eps)^p / unit)   w = weights[i] / 2^32, a = pixels[i]; p is 1, 1/2 or 0; in
//                                                 float64, to the nearest integer, ties to even
//   seen[g]    += whether the splat has a radius
//   counted[g] += counts[i]
//   cull[g]     : the bit columns[v_i] is cleared if counts[i]; bit c is bit c % 32 of word c / 32
//
//   weights int64 [P], pixels int32 [P], radii int32 [P, 2], camera_ids int32 [P], counts bool [P],
//   visible_ids int32 [U], splat_offsets int32 [U + 1]; score int64 [N], seen and counted int32 [N],
//   cull int32 [N, words]
//
// counts[i]: the splat is in its view's mass cut (mass_cut.h). The sums are integers, and one thread computes
// those of a Gaussian, so they are exact and need no atomics. The cost is O(P).

enum class ScoreRule : int { kWeight = 0, kRoot = 1, kDensity = 2 };

// Clears the bits of one word of a Gaussian's row of the cull matrix after the other. It stores a word only
// when the next bit is in another one, because stores would keep the loads of later splats waiting.
struct CullRow {
  uint32_t* words;
  int32_t word = 0;
  uint32_t bits = 0;

  BLITZGS_HD void clear(int32_t column) {
    if (column / 32 != word) store();
    word = column / 32;
    bits |= 1u << column % 32;
  }
  BLITZGS_HD void store() {
    if (bits != 0) words[word] &= ~bits;
    bits = 0;
  }
};

struct ViewSums {
  const int64_t* weights;
  const int32_t *pixels, *radii, *camera_ids;
  const bool* counts;
  const int32_t *visible_ids, *splat_offsets;
  int64_t n, words;
  int64_t* score;
  int32_t *seen, *counted;
  uint32_t* cull;
  ScoreRule rule;
  double eps, unit;
  int32_t columns[kMaxViews];

  BLITZGS_HD void operator()(int64_t u) const {
    const int32_t id = visible_ids[u];
    int64_t sum = 0;
    int32_t views = 0, views_counted = 0;
    CullRow row{cull + id * words};
    for (int64_t i = splat_offsets[u]; i < splat_offsets[u + 1]; ++i) {
      sum += score_term(i);
      views += radii[2 * i] > 0 || radii[2 * i + 1] > 0;
      if (!counts[i]) continue;
      ++views_counted;
      row.clear(columns[camera_ids[i]]);
    }
    row.store();
    score[id] += sum;
    seen[id] += views;
    counted[id] += views_counted;
  }

 private:
  // The summand of a splat, in units of the score, rounded to the nearest integer, ties to even.
  BLITZGS_HD int64_t score_term(int64_t splat) const {
    double term = double(weights[splat]) / 4294967296.0;
    const double area = double(pixels[splat]) + eps;
    if (rule == ScoreRule::kDensity) term = term / area;
    if (rule == ScoreRule::kRoot) term = term / std::sqrt(area);
#ifdef __CUDA_ARCH__
    return __double2ll_rn(term / unit);
#else
    return int64_t(std::nearbyint(term / unit));
#endif
  }
};

}  // namespace blitzgs
