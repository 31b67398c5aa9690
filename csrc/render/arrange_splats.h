// SPDX-License-Identifier: Apache-2.0
// Copies rows of several columns at once between the order of the splats and the arrangement in which
// `blitzgs.rasterization` returns them: its third result, the dictionary `meta` of gsplat's interface
// (blitzgs/call/layout.py).
//
// With `order` [n], entry i of the arrangement is splat order[i]. Without it, splat i is the entry
// images[i] * count + gaussians[i] of an arrangement that has an entry for each Gaussian in each image. A row
// has `words` words of 4 bytes, and a row of the source begins `stride` words after the row before. Indices
// are not checked.
#pragma once
#include <array>
#include <cstdint>

#include "common/kernel.h"

namespace blitzgs {

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
void fill_entries(const EmptyEntries&, CudaStream);
void arrange_splats(const ArrangeSplats&, bool back, CudaStream);
}  // namespace BLITZGS_BACKEND

}  // namespace blitzgs
