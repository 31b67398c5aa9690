// SPDX-License-Identifier: Apache-2.0
// What a call needs beyond the projection (project.h), intersect (intersect.h) and rasterize_fwd
// (rasterize.h): rows of the visible Gaussians, alphas, and splats in the arrangement of `meta`.
#pragma once
#include <array>
#include <cstdint>

#include "common/kernel.h"
#include "project/project.h"

namespace blitzgs {

// alphas[i] = 1 - transmittances[i], 0 <= i < n.
template <class T>
struct Alphas {
  const T* transmittances;
  T* alphas;
  std::int64_t n;

  BLITZGS_HD void operator()(std::int64_t i) const { alphas[i] = T(1) - transmittances[i]; }
};

// Gathers the same rows of several columns in one launch. A row of a column has `width` words of 4 bytes:
//   column.to[i stride + k] = column.from[ids[i] from_stride + k],  0 <= i < n,  0 <= k < width.
// With a stride above the width, several columns are gathered side by side into one; with a from_stride above
// the width, a column is a part of wider rows. ids int32 [n], rows of the columns, not checked; null: 0 to n
// - 1. known: null, or (CUDA) the number of valid ids, see valid_splat_count in common/kernel.h.

constexpr int kMaxGatheredColumns = 8;

struct GatheredColumn {
  const std::uint32_t* from;
  std::uint32_t* to;
  std::int64_t from_stride, stride;
  std::uint32_t width;
};

struct GatherRows {
  const std::int32_t* ids;
  std::int64_t n;
  const std::int64_t* known;
  int n_columns;
  GatheredColumn columns[kMaxGatheredColumns];
};

// A call with SH gathers the rows of the visible Gaussians of a projection (project.h) into a small table,
// row u for the Gaussian visible_ids[u]. This op writes the numbers that lead from rows and splats to each
// other:
//   rows[u] = u;   indices[u] = visible_ids[u];
//   row_of_splat[i] = u for the splats i of this Gaussian, splat_offsets[u] <= i < splat_offsets[u + 1].
// On CUDA nothing is written if there are more splats than the capacity. On the CPU the sizes of the capacity
// are the actual numbers.

struct NumberedRows {
  const std::int32_t* visible_ids;    // [U]
  const std::int32_t* splat_offsets;  // [U + 1]
  std::int32_t* rows;                 // [U]
  std::int64_t* indices;              // [U]
  std::int32_t* row_of_splat;         // [P]
};

BLITZGS_HD void number_row(const NumberedRows& numbered, std::int32_t u) {
  numbered.rows[u] = u;
  numbered.indices[u] = numbered.visible_ids[u];
  for (std::int32_t i = numbered.splat_offsets[u]; i < numbered.splat_offsets[u + 1]; ++i) {
    numbered.row_of_splat[i] = u;
  }
}

// Copies rows of several columns at once between the order of the splats and the arrangement in which
// `blitzgs.rasterization` returns them: its third result, the dictionary `meta` of gsplat's interface
// (blitzgs/call/layout.py).
//
// With `order` [n], entry i of the arrangement is splat order[i]. Without it, splat i is the entry
// images[i] * count + gaussians[i] of an arrangement that has an entry for each Gaussian in each image. A row
// has `words` words of 4 bytes, and a row of the source begins `stride` words after the row before. Indices
// are not checked.

inline constexpr int kMaxArranged = 8;  // columns of one call

struct ArrangedColumn {
  const std::uint32_t* from;
  std::uint32_t* to;
  std::int64_t words, stride;
};

struct ArrangeSplats {
  const std::int64_t* order;
  const std::int32_t *images, *gaussians;
  std::int64_t n, count;
  int n_columns;
  std::array<ArrangedColumn, kMaxArranged> columns;

  BLITZGS_HD std::int64_t splat(std::int64_t i) const { return order ? order[i] : i; }
  BLITZGS_HD std::int64_t entry(std::int64_t i) const { return order ? i : images[i] * count + gaussians[i]; }
};

// The entries [entries] of a column before its splats are copied: entries without a splat keep this value,
// which is zero or, with `under` [scenes, count], that of their Gaussian. An image is one of `views` images
// of its scene.
struct EmptyEntries {
  ArrangedColumn column;
  std::int64_t entries, count, views;
  const std::uint32_t* under;

  BLITZGS_HD std::int64_t source(std::int64_t entry) const {
    return entry / (views * count) * count + entry % count;
  }
};

namespace BLITZGS_BACKEND {
void gather_rows(const GatherRows&, CudaStream);
void number_rows(const NumberedRows&, const ProjectCapacity&, CudaStream);
void fill_entries(const EmptyEntries&, CudaStream);
void arrange_splats(const ArrangeSplats&, bool back, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
