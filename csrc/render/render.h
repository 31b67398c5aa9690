// SPDX-License-Identifier: Apache-2.0
// What a call needs beyond the projection (project.h), intersect (intersect.h) and rasterize_fwd
// (rasterize.h): rows of the visible Gaussians, alphas, and splats in the arrangement of `meta`.
#pragma once
#include "project/project.h"

namespace blitzgs {

// alphas[i] = 1 - transmittances[i], 0 <= i < n.
template <class T> struct Alphas {
  const T* transmittances;
  T* alphas;
  int64_t n;

  BLITZGS_HD void operator()(int64_t i) const { alphas[i] = T(1) - transmittances[i]; }
};

// Gathers the same rows of several columns in one launch. A row of a column has `width` words of 4 bytes:
//   column.to[i stride + k] = column.from[ids[i] width + k],  0 <= i < n,  0 <= k < width.
// With a stride above the width, several columns are gathered side by side into one. ids int32 [n], rows of
// the columns, not checked. known: null, or (CUDA) the number of valid ids, see valid_splat_count.

constexpr int kMaxGatheredColumns = 8;

struct GatheredColumn {
  const uint32_t* from;
  uint32_t* to;
  int64_t stride;
  uint32_t width;
};

struct GatherRows {
  const int32_t* ids;
  int64_t n;
  const int64_t* known;
  int n_columns;
  GatheredColumn columns[kMaxGatheredColumns];
};

// A call with SH gathers the rows of the visible Gaussians of a projection (project.h) into a small table,
// row u for the Gaussian visible_ids[u]. This writes the numbers that lead from rows and splats to each
// other; nothing, if there are more splats than the capacity.
struct NumberedRows {
  ProjectCapacity capacity;
  const int32_t* visible_ids;    // [U]
  const int32_t* splat_offsets;  // [U + 1]
  int32_t* rows;                 // [U]
  int64_t* indices;              // [U]
  int32_t* row_of_splat;         // [P]
  int64_t n;                     // U of the capacity

  BLITZGS_HD void operator()(int64_t u) const {
    if (u >= capacity.fitting().visible) return;
    rows[u] = int32_t(u);
    indices[u] = visible_ids[u];
    for (int32_t i = splat_offsets[u]; i < splat_offsets[u + 1]; ++i) row_of_splat[i] = rows[u];
  }
};

// Copies rows of several columns at once between the order of the splats and the arrangement in which
// `blitzgs.rasterization` returns them: its third result, the dictionary `meta` of gsplat's interface
// (blitzgs/call/layout.py).
//
// With `order` [n], entry i of the arrangement is splat order[i]. Without it, splat i is the entry
// images[i] * count + gaussians[i] of an arrangement that has an entry for each Gaussian in each image. A row
// has `words` words of 4 bytes, and rows of the source begin `stride` words apart. Indices are not checked.

inline constexpr int kMaxArranged = 8;  // columns of one call

struct ArrangedColumn {
  const uint32_t* from;
  uint32_t* to;
  int64_t words, stride;
};

struct ArrangeSplats {
  const int64_t* order;
  const int32_t *images, *gaussians;
  int64_t n, count;
  bool back;  // from the arrangement to the order of the splats
  int n_columns;
  ArrangedColumn columns[kMaxArranged];

  BLITZGS_HD void operator()(int64_t i) const {
    const int64_t splat = order ? order[i] : i, entry = order ? i : images[i] * count + gaussians[i];
    for (int c = 0; c < n_columns; ++c) {
      const ArrangedColumn& column = columns[c];
      const uint32_t* from = column.from + (back ? entry : splat) * column.stride;
      uint32_t* to = column.to + (back ? splat : entry) * column.words;
      for (int64_t k = 0; k < column.words; ++k) to[k] = from[k];
    }
  }
};

// Gives the entries of a column, before its splats are copied, the values `under` [scenes, count] of their
// Gaussians, which those without a splat keep. An image is one of `views` images of its scene.
struct UnderSplats {
  const uint32_t* under;
  uint32_t* to;
  int64_t n, words, count, views;

  BLITZGS_HD void operator()(int64_t i) const {
    const int64_t source = i / (views * count) * count + i % count;
    for (int64_t k = 0; k < words; ++k) to[i * words + k] = under[source * words + k];
  }
};

namespace BLITZGS_BACKEND {
void gather_rows(const GatherRows&, CudaStream);
void zero_words(uint32_t* words, int64_t n, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
