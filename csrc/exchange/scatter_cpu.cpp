// SPDX-License-Identifier: Apache-2.0
#include "exchange/scatter.h"

#include <algorithm>
#include <cstring>

#include "common/parallel.h"

namespace blitzgs::cpu {

void scatter(const ScatterSplats& splats, const SplatGroups& groups, const ScatterTargets& targets,
             SplatPlace* places, Workspace&, CudaStream) {
  const int n_ranks = groups.count;
  const std::int64_t runs = place_runs(splats.count);
  parallel_for(0, runs, 256, [&](std::int64_t begin, std::int64_t end) {
    std::fill(places + begin * n_ranks, places + end * n_ranks, SplatPlace{});
    for (std::int64_t splat = begin * kPlaceSplats; splat < std::min(splats.count, end * kPlaceSplats);
         ++splat) {
      SplatPlace* run = places + splat / kPlaceSplats * n_ranks;
      for (int m = 0; m < n_ranks; ++m) {
        run[m].bits |= static_cast<std::uint32_t>((splats.masks[splat] >> m) & 1) << splat % kPlaceSplats;
      }
    }
  });
  for (int m = 0; m < n_ranks; ++m) {
    std::int32_t before = 0;
    for (std::int64_t run = 0; run < runs; ++run) {
      SplatPlace& place = places[run * n_ranks + m];
      place.first = before;
      before += count_bits(place.bits);
    }
  }
  parallel_for(0, runs, 256, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t splat = begin * kPlaceSplats; splat < std::min(splats.count, end * kPlaceSplats);
         ++splat) {
      const SplatPlace* run = places + splat / kPlaceSplats * n_ranks;
      for (int m = 0; m < n_ranks; ++m) {
        const auto in_run = static_cast<std::uint32_t>(splat % kPlaceSplats);
        const std::int64_t at = run[m].of(in_run);
        if (!run[m].has(in_run) || at >= groups.size[m]) continue;
        for (int c = 0; c < splats.columns.count; ++c) {
          const std::int64_t width = splats.columns.begin[c + 1] - splats.columns.begin[c];
          std::memcpy(targets.words[m][c] + at * width, splats.columns.data[c] + splat * width, 4 * width);
        }
      }
    }
  });
}

void gather(const std::int32_t* packed, const SplatGroups& groups, const SplatColumns<std::int32_t>& columns,
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
void sum(const SplatValues<T>& in, const SplatColumns<T>& out, Workspace&, CudaStream) {
  for (int c = 0; c < out.count; ++c) {
    std::fill_n(out.data[c], in.count * (out.begin[c + 1] - out.begin[c]), T(0));
  }
  parallel_for(0, in.count, 8192, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t splat = begin; splat < end; ++splat) {
      in.for_each(splat, [&](const T* values) {
        for (int c = 0; c < out.count; ++c) {
          const int width = out.begin[c + 1] - out.begin[c];
          for (int k = 0; k < width; ++k) out.data[c][splat * width + k] += values[out.begin[c] + k];
        }
      });
    }
  });
}

template void sum<float>(const SplatValues<float>&, const SplatColumns<float>&, Workspace&, CudaStream);
template void sum<double>(const SplatValues<double>&, const SplatColumns<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
