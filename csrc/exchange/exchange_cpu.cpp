// SPDX-License-Identifier: Apache-2.0
#include <bit>
#include <cstring>

#include "common/parallel.h"
#include "exchange/scatter.h"
#include "exchange/tile_costs.h"

namespace blitzgs::cpu {

void scatter(const ScatterSplats& splats, const SplatGroups& groups, const ScatterTargets& targets,
             SplatPlace* places, Workspace&, CudaStream) {
  const int n_ranks = groups.count;
  const int64_t runs = place_runs(splats.count);
  const auto for_each_splat = [&](const auto& f) {
    parallel_rows(runs, 256, [&](int64_t run) {
      const int64_t begin = run * kPlaceSplats, end = std::min(splats.count, begin + kPlaceSplats);
      for (int64_t splat = begin; splat < end; ++splat) f(places + run * n_ranks, splat);
    });
  };
  std::fill_n(places, runs * n_ranks, SplatPlace{});
  for_each_splat([&](SplatPlace* run, int64_t splat) {
    for (int m = 0; m < n_ranks; ++m) {
      run[m].bits |= uint32_t((splats.masks[splat] >> m) & 1) << splat % kPlaceSplats;
    }
  });
  for (int m = 0; m < n_ranks; ++m) {
    int32_t before = 0;
    for (int64_t run = 0; run < runs; ++run) {
      SplatPlace& place = places[run * n_ranks + m];
      place.first = before;
      before += count_bits(place.bits);
    }
  }
  for_each_splat([&](const SplatPlace* run, int64_t splat) {
    const auto in_run = uint32_t(splat % kPlaceSplats);
    for (int m = 0; m < n_ranks; ++m) {
      const int64_t at = run[m].of(in_run);
      if (!run[m].has(in_run) || at >= groups.size[m]) continue;
      for (int c = 0; c < splats.columns.count; ++c) {
        const int64_t width = splats.columns.begin[c + 1] - splats.columns.begin[c];
        std::memcpy(targets.words[m][c] + at * width, splats.columns.data[c] + splat * width, 4 * width);
      }
    }
  });
}

void gather(const int32_t* packed, const SplatGroups& groups, const SplatColumns<int32_t>& columns,
            CudaStream) {
  const int64_t total = columns.begin[columns.count];
  for (int m = 0; m < groups.count; ++m) {
    for (int c = 0; c < columns.count; ++c) {
      const int64_t width = columns.begin[c + 1] - columns.begin[c];
      const int32_t* from = packed + groups.start[m] * total + groups.size[m] * columns.begin[c];
      std::copy_n(from, groups.size[m] * width, columns.data[c] + groups.start[m] * width);
    }
  }
}

template <class T> void sum(const SplatValues<T>& in, const SplatColumns<T>& out, CudaStream) {
  for (int c = 0; c < out.count; ++c) {
    std::fill_n(out.data[c], in.count * (out.begin[c + 1] - out.begin[c]), T(0));
  }
  parallel_rows(in.count, 8192, [&](int64_t splat) {
    in.for_each(splat, [&](const T* values) {
      for (int c = 0; c < out.count; ++c) {
        const int width = out.begin[c + 1] - out.begin[c];
        for (int k = 0; k < width; ++k) out.data[c][splat * width + k] += values[out.begin[c] + k];
      }
    });
  });
}

BLITZGS_FOR_BOTH_DTYPES(sum);

namespace {

// Number of neighbouring costs that are added up first. Only stretches with a bound are searched by tile.
constexpr int64_t kStretch = 128;

// Conversions between float and float16 of values >= 0. They use integer operations, which the compiler
// vectorises for every processor; not all have instructions for float16.

uint16_t to_half(float value) {
  value = value < 65504.0f ? value : 65504.0f;
  const auto bits = std::bit_cast<uint32_t>(value);
  // The exponent's bias becomes 15 instead of 127, and 13 bits of the mantissa are rounded away.
  const uint32_t normal = (bits - (112u << 23) + 0xfffu + (bits >> 13 & 1u)) >> 13;
  // Below 2^-14, halves are multiples of 2^-24, as are the floats from 0.5 on: the addition rounds.
  const uint32_t small = std::bit_cast<uint32_t>(value + 0.5f) - std::bit_cast<uint32_t>(0.5f);
  return uint16_t(value < 0x1p-14f ? small : normal);
}

float to_float(uint16_t half) {
  // The product restores the exponent, also of halves below 2^-14.
  return std::bit_cast<float>(uint32_t(half) << 13) * 0x1p112f;
}

// Spreads the `pieces` values at the begin of a row over the `tiles` of the row, in its own memory. The last
// piece comes first, because it is spread over places behind the pieces that are still to be read.
void spread(float* row, int64_t pieces, int64_t grain, int64_t tiles) {
  for (int64_t piece = pieces - 1; piece >= 0; --piece) {
    const float value = row[piece];
    std::fill(row + piece * grain, row + std::min((piece + 1) * grain, tiles), value);
  }
}

void write_mean(const BatchCosts& costs, int64_t pieces, float* mean) {
  std::fill_n(mean, pieces, 0.0f);
  for (int64_t view = 0; view < costs.n_similar; ++view) {
    const uint16_t* halves = costs.similar[view];
    for (int64_t i = 0; i < pieces; ++i) mean[i] += to_float(halves[i]);
  }
  const float count = float(std::max<int64_t>(costs.n_similar, 1));
  for (int64_t i = 0; i < pieces; ++i) mean[i] /= count;
}

void write_costs(const BatchCosts& costs, Workspace& workspace, float* out) {
  const int64_t pieces = (costs.tiles + costs.grain - 1) / costs.grain;
  const float* mean = nullptr;
  if (std::find(costs.views, costs.views + costs.n_views, nullptr) != costs.views + costs.n_views) {
    float* means = workspace.allocate<float>(pieces);
    write_mean(costs, pieces, means);
    mean = means;
  }
  for (int64_t view = 0; view < costs.n_views; ++view) {
    float* row = out + view * costs.tiles;
    if (const uint16_t* halves = costs.views[view]) {
      for (int64_t i = 0; i < pieces; ++i) row[i] = to_float(halves[i]) + costs.tile_cost;
    } else {
      for (int64_t i = 0; i < pieces; ++i) row[i] = mean[i] + costs.tile_cost;
    }
    if (costs.grain > 1) spread(row, pieces, costs.grain, costs.tiles);
  }
}

// Several partial sums, so that additions need not wait for each other.
double sum_of(const float* values, int64_t count) {
  constexpr int kLanes = 8;
  double lanes[kLanes] = {};
  int64_t i = 0;
  for (; i + kLanes <= count; i += kLanes) {
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] += values[i + lane];
  }
  for (; i < count; ++i) lanes[0] += values[i];
  double sum = 0;
  for (const double lane : lanes) sum += lane;
  return sum;
}

}  // namespace

void store_tile_costs(const float* costs, int64_t tiles, int64_t grain, uint16_t* pieces) {
  if (grain == 1) {
    for (int64_t tile = 0; tile < tiles; ++tile) pieces[tile] = to_half(costs[tile]);
    return;
  }
  for (int64_t first = 0; first < tiles; first += grain) {
    const int64_t count = std::min(grain, tiles - first);
    float sum = 0;
    for (int64_t i = 0; i < count; ++i) sum += costs[first + i];
    pieces[first / grain] = to_half(sum / float(count));
  }
}

void divide_tiles(const BatchCosts& costs, int64_t parts, Workspace& workspace, int64_t* bounds) {
  const int64_t n = costs.n_views * costs.tiles, stretches = (n + kStretch - 1) / kStretch;
  float* cost = workspace.allocate<float>(n);
  double* ends = workspace.allocate<double>(stretches + 1);
  write_costs(costs, workspace, cost);
  ends[0] = 0;
  for (int64_t s = 0; s < stretches; ++s) {
    ends[s + 1] = ends[s] + sum_of(cost + s * kStretch, std::min(kStretch, n - s * kStretch));
  }
  const double total = ends[stretches];
  bounds[0] = 0;
  bounds[parts] = n;
  for (int64_t part = 1; part < parts; ++part) {
    const double share = total * double(part) / double(parts);
    const int64_t reached = std::lower_bound(ends, ends + stretches + 1, share) - ends;
    const int64_t stretch = std::max<int64_t>(reached - 1, 0);
    int64_t tile = stretch * kStretch;
    double before = ends[stretch], after = before + cost[tile];
    for (const int64_t last = std::min(tile + kStretch, n) - 1; after < share && tile < last;) {
      before = after;
      after += cost[++tile];
    }
    bounds[part] = tile + (share - before >= after - share);
  }
}

}  // namespace blitzgs::cpu
