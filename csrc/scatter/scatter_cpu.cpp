// SPDX-License-Identifier: Apache-2.0
#include "scatter/scatter.h"

#include <algorithm>
#include <cstring>

#include "common/parallel.h"

namespace blitzgs::cpu {

void scatter(const ScatterRows& rows, const RowGroups& groups, const ScatterTargets& targets,
             RowPlace* places, Workspace&, CudaStream) {
  const int n_ranks = groups.count;
  const std::int64_t runs = place_runs(rows.count);
  parallel_for(0, runs, 256, [&](std::int64_t begin, std::int64_t end) {
    std::fill(places + begin * n_ranks, places + end * n_ranks, RowPlace{});
    for (std::int64_t row = begin * kPlaceRows; row < std::min(rows.count, end * kPlaceRows); ++row) {
      RowPlace* run = places + row / kPlaceRows * n_ranks;
      for (int m = 0; m < n_ranks; ++m) {
        run[m].bits |= static_cast<std::uint32_t>((rows.masks[row] >> m) & 1) << row % kPlaceRows;
      }
    }
  });
  for (int m = 0; m < n_ranks; ++m) {
    std::int32_t before = 0;
    for (std::int64_t run = 0; run < runs; ++run) {
      RowPlace& place = places[run * n_ranks + m];
      place.first = before;
      before += count_bits(place.bits);
    }
  }
  parallel_for(0, runs, 256, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t row = begin * kPlaceRows; row < std::min(rows.count, end * kPlaceRows); ++row) {
      const RowPlace* run = places + row / kPlaceRows * n_ranks;
      for (int m = 0; m < n_ranks; ++m) {
        const auto in_run = static_cast<std::uint32_t>(row % kPlaceRows);
        const std::int64_t at = run[m].of(in_run);
        if (!run[m].has(in_run) || at >= groups.size[m]) continue;
        for (int c = 0; c < rows.columns.count; ++c) {
          const std::int64_t width = rows.columns.begin[c + 1] - rows.columns.begin[c];
          std::memcpy(targets.words[m][c] + at * width, rows.columns.data[c] + row * width, 4 * width);
        }
      }
    }
  });
}

void gather(const std::int32_t* packed, const RowGroups& groups, const RowColumns<std::int32_t>& columns,
            Workspace&, CudaStream) {
  const std::int64_t total = columns.begin[columns.count];
  for (int m = 0; m < groups.count; ++m) {
    for (int c = 0; c < columns.count; ++c) {
      const std::int64_t width = columns.begin[c + 1] - columns.begin[c];
      const std::int32_t* from = packed + groups.start[m] * total + groups.size[m] * columns.begin[c];
      std::copy_n(from, groups.size[m] * width, columns.data[c] + groups.start[m] * width);
    }
  }
}

template <class T>
void sum(const RowValues<T>& in, const RowColumns<T>& out, Workspace&, CudaStream) {
  for (int c = 0; c < out.count; ++c) {
    std::fill_n(out.data[c], in.count * (out.begin[c + 1] - out.begin[c]), T(0));
  }
  parallel_for(0, in.count, 8192, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t row = begin; row < end; ++row) {
      in.for_each(row, [&](const T* values) {
        for (int c = 0; c < out.count; ++c) {
          const int width = out.begin[c + 1] - out.begin[c];
          for (int k = 0; k < width; ++k) out.data[c][row * width + k] += values[out.begin[c] + k];
        }
      });
    }
  });
}

template void sum<float>(const RowValues<float>&, const RowColumns<float>&, Workspace&, CudaStream);
template void sum<double>(const RowValues<double>&, const RowColumns<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
