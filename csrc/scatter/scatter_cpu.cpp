// SPDX-License-Identifier: Apache-2.0
#include "scatter/scatter.h"

#include <algorithm>
#include <cstring>

#include "common/parallel.h"

namespace blitzgs::cpu {

namespace {

// Calls f(row, rank, position in the block's part of the rank's group) for the rows of a block, in order.
template <class F>
void for_each_destination(const std::int64_t* masks, std::int64_t block, std::int64_t n_rows, int n_ranks,
                          const F& f) {
  std::int64_t taken[kMaxRanks] = {};
  const std::int64_t end = std::min(n_rows, (block + 1) * kScatterBlock);
  for (std::int64_t row = block * kScatterBlock; row < end; ++row) {
    for (int m = 0; m < n_ranks; ++m) {
      if ((masks[row] >> m) & 1) f(row, m, taken[m]++);
    }
  }
}

}  // namespace

void scatter(const ScatterRows& rows, const RowGroups& groups, const ScatterTargets& targets,
             std::int32_t* bases, Workspace&, CudaStream) {
  const int n_ranks = groups.count;
  const std::int64_t blocks = scatter_blocks(rows.count);
  parallel_for(0, blocks, 32, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      std::int32_t* counts = bases + block * n_ranks;
      std::fill(counts, counts + n_ranks, 0);
      for_each_destination(rows.masks, block, rows.count, n_ranks,
                           [&](std::int64_t, int m, std::int64_t) { ++counts[m]; });
    }
  });
  for (int m = 0; m < n_ranks; ++m) {
    std::int32_t before = 0;
    for (std::int64_t block = 0; block < blocks; ++block) {
      const std::int32_t count = bases[block * n_ranks + m];
      bases[block * n_ranks + m] = before;
      before += count;
    }
  }
  parallel_for(0, blocks, 32, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      for_each_destination(
          rows.masks, block, rows.count, n_ranks, [&](std::int64_t row, int m, std::int64_t position) {
            const std::int64_t at = bases[block * n_ranks + m] + position;
            if (at >= groups.size[m]) return;
            for (int c = 0; c < rows.columns.count; ++c) {
              const std::int64_t width = rows.columns.begin[c + 1] - rows.columns.begin[c];
              std::memcpy(targets.words[m][c] + at * width, rows.columns.data[c] + row * width, 4 * width);
            }
          });
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
void sum(const ReturnedRows<T>& in, const RowColumns<T>& out, Workspace&, CudaStream) {
  const int n_ranks = in.groups.count;
  for (int c = 0; c < out.count; ++c) {
    std::fill_n(out.data[c], in.count * (out.begin[c + 1] - out.begin[c]), T(0));
  }
  parallel_for(0, scatter_blocks(in.count), 32, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t block = begin; block < end; ++block) {
      for_each_destination(in.masks, block, in.count, n_ranks,
                           [&](std::int64_t row, int m, std::int64_t position) {
                             const std::int64_t at = in.bases[block * n_ranks + m] + position;
                             if (at >= in.groups.size[m]) return;
                             const T* values = in.values + (in.groups.start[m] + at) * in.width;
                             for (int c = 0; c < out.count; ++c) {
                               const int width = out.begin[c + 1] - out.begin[c];
                               for (int k = 0; k < width; ++k)
                                 out.data[c][row * width + k] += values[out.begin[c] + k];
                             }
                           });
    }
  });
}

template void sum<float>(const ReturnedRows<float>&, const RowColumns<float>&, Workspace&, CudaStream);
template void sum<double>(const ReturnedRows<double>&, const RowColumns<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
