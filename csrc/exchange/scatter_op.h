// SPDX-License-Identifier: Apache-2.0
// The checked arguments that the ops on scattered splats share.
#pragma once
#include <limits>

#include "common/op.h"
#include "exchange/places_op.h"
#include "exchange/scatter.h"

namespace blitzgs {

inline SplatGroups checked_groups(const char* op, const char* name, const std::vector<std::int64_t>& sizes) {
  const auto count = static_cast<std::int64_t>(sizes.size());
  STD_TORCH_CHECK(count >= 1 && count <= kMaxRanks, "blitzgs::", op, ": ", name, " must have 1 to ",
                  kMaxRanks, " entries, got ", count);
  SplatGroups groups{};
  groups.count = static_cast<int>(count);
  std::int64_t splats = 0;
  for (std::int64_t m = 0; m < count; ++m) {
    STD_TORCH_CHECK(sizes[m] >= 0 && sizes[m] <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op,
                    ": ", name, " must be in [0, 2^31), got ", sizes[m]);
    groups.size[m] = sizes[m];
    groups.start[m] = splats;
    splats += sizes[m];
  }
  return groups;
}

inline std::int64_t total_splats(const SplatGroups& groups) {
  return groups.start[groups.count - 1] + groups.size[groups.count - 1];
}

// Appends a column with `width` words per splat.
template <class Word>
void add_column(const char* op, SplatColumns<Word>& columns, Word* data, std::int64_t width) {
  STD_TORCH_CHECK(columns.count < kMaxSplatColumns, "blitzgs::", op, ": at most ", kMaxSplatColumns,
                  " columns");
  const std::int64_t end = columns.begin[columns.count] + width;
  STD_TORCH_CHECK(width >= 0 && end <= 4096, "blitzgs::", op, ": a splat may have 4096 words, got ", end);
  columns.data[columns.count] = data;
  columns.begin[++columns.count] = static_cast<int>(end);
}

// Columns int32 [P, w] and masks int64 [P]; keeps the contiguous forms alive.
struct HeldSplats {
  HeldSplats(const char* op, const std::vector<Tensor>& columns, const Tensor& masks_in)
      : masks(checked(op, "masks", masks_in, ScalarType::Long, {-1})) {
    splats.masks = data<std::int64_t>(masks);
    splats.count = masks.size(0);
    STD_TORCH_CHECK(splats.count <= std::numeric_limits<std::int32_t>::max(), "blitzgs::", op, ": ",
                    splats.count, " splats exceed 2^31 - 1; project fewer views at a time");
    for (const Tensor& column : columns) {
      held.push_back(checked(op, "a column", column, ScalarType::Int, {splats.count, -1}));
      add_column(op, splats.columns, data<std::int32_t>(held.back()), column.size(1));
    }
  }

  Tensor masks;
  std::vector<Tensor> held;
  ScatterSplats splats{};
};

inline Tensor make_places(const Tensor& like, std::int64_t splats, std::int64_t n_ranks) {
  return make_empty(like, {place_runs(splats), n_ranks}, ScalarType::Long);
}

inline SplatPlace* places_of(Tensor& places) {
  static_assert(sizeof(SplatPlace) == sizeof(std::int64_t));
  return reinterpret_cast<SplatPlace*>(mutable_data<std::int64_t>(places));
}

}  // namespace blitzgs
