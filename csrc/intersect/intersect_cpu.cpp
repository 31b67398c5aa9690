// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <vector>

#include "common/parallel.h"
#include "intersect/intersect.h"

namespace blitzgs::cpu {
namespace {

// The tiles of one tile row that a splat touches: [first, first + count), counted from grid.tile_begin.
struct Span {
  int32_t splat;
  int32_t count;
  int64_t first;
};

template <class T> using KeyOf = decltype(ordered_bits(T()));

template <class Key> struct Keyed {
  Key key;
  int32_t splat;
};

template <class T, class F> void for_each_span(const IntersectInput<T>& in, int32_t splat, const F& f) {
  const TileGrid& grid = in.grid;
  const int64_t image = in.camera_ids[splat] * grid.per_image();
  for_each_tile_row(in.means2d + 2 * int64_t(splat), in.conics + 3 * int64_t(splat), in.opacities[splat],
                    grid.width, grid.height, grid.tile_size, [&](int ty, int begin, int end) {
                      const int64_t tile_row = image + int64_t(ty) * grid.tiles_x;
                      const int64_t first = std::max(tile_row + begin, grid.tile_begin);
                      const int64_t last = std::min(tile_row + end, grid.tile_end);
                      if (first < last) f(first - grid.tile_begin, int32_t(last - first));
                    });
}

// Calls f(piece, begin, end) for [0, n) in `pieces` pieces of nearly equal length.
template <class F> void parallel_pieces(int64_t n, int pieces, const F& f) {
  parallel_rows(pieces, 1,
                [&](int64_t piece) { f(int(piece), n * piece / pieces, n * (piece + 1) / pieces); });
}

// One stable counting pass on 11 bits. Returns false and moves nothing when all keys have the same 11 bits.
template <class Key> bool radix_pass(const Keyed<Key>* from, Keyed<Key>* to, int64_t n, int shift) {
  constexpr int kBuckets = 1 << 11;
  const int pieces = num_threads();
  const auto bucket_of = [shift](Key key) { return int(key >> shift) & (kBuckets - 1); };
  std::vector<std::array<int64_t, kBuckets>> places(pieces);
  parallel_pieces(n, pieces, [&](int piece, int64_t begin, int64_t end) {
    places[piece].fill(0);
    for (int64_t i = begin; i < end; ++i) ++places[piece][bucket_of(from[i].key)];
  });
  int64_t place = 0;
  for (int bucket = 0; bucket < kBuckets; ++bucket) {
    const int64_t start = place;
    for (auto& counts : places) {
      const int64_t count = counts[bucket];
      counts[bucket] = place;
      place += count;
    }
    if (place - start == n) return false;
  }
  parallel_pieces(n, pieces, [&](int piece, int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) to[places[piece][bucket_of(from[i].key)]++] = from[i];
  });
  return true;
}

// Orders each run of splats with equal depths by id. The stable sort left them in splat order.
template <class Key> void order_ties(Keyed<Key>* splats, int64_t n, const int64_t* ids) {
  for (int64_t begin = 0; begin < n;) {
    int64_t end = begin + 1;
    while (end < n && splats[end].key == splats[begin].key) ++end;
    if (end - begin > 1) {
      std::sort(splats + begin, splats + end, [ids](const Keyed<Key>& a, const Keyed<Key>& b) {
        return ids[a.splat] != ids[b.splat] ? ids[a.splat] < ids[b.splat] : a.splat < b.splat;
      });
    }
    begin = end;
  }
}

// Returns the splats of all cameras sorted by (depth, id), the order of compositing.
template <class T> const Keyed<KeyOf<T>>* sort_splats(const IntersectInput<T>& in, Workspace& workspace) {
  using Key = KeyOf<T>;
  auto* splats = workspace.allocate<Keyed<Key>>(in.n_splats);
  auto* spare = workspace.allocate<Keyed<Key>>(in.n_splats);
  parallel_rows(in.n_splats, 1 << 14,
                [&](int64_t i) { splats[i] = {ordered_bits(in.depths[i]), int32_t(i)}; });
  for (int shift = 0; shift < int(8 * sizeof(Key)); shift += 11) {
    if (radix_pass(splats, spare, in.n_splats, shift)) std::swap(splats, spare);
  }
  if (in.ids) order_ties(splats, in.n_splats, in.ids);
  return splats;
}

// The number of pieces is the number of threads, or fewer where their counters would take too much memory.
int choose_pieces(int64_t n_tiles) {
  constexpr int64_t kMaxCounts = 1 << 25;
  return int(std::clamp<int64_t>(kMaxCounts / std::max<int64_t>(n_tiles, 1), 1, num_threads()));
}

}  // namespace

template <class T> int64_t count_intersections(const IntersectInput<T>& in, Workspace&, CudaStream) {
  std::atomic<int64_t> total{0};
  parallel_for(0, in.n_splats, 1 << 12, [&](int64_t begin, int64_t end) {
    int64_t count = 0;
    for (int64_t splat = begin; splat < end; ++splat) {
      for_each_span(in, int32_t(splat), [&](int64_t, int32_t n) { count += n; });
    }
    total += count;
  });
  return total;
}

template <class T>
int64_t intersect(const IntersectInput<T>& in, int64_t capacity, int32_t* isect_splats, int64_t* tile_offsets,
                  Workspace& workspace, CudaStream) {
  const TileGrid& grid = in.grid;
  const int64_t n_tiles = grid.tile_end - grid.tile_begin;
  const auto* splats = sort_splats(in, workspace);

  // First, each piece of the sorted splats records its spans and counts its entries per tile.
  const int pieces = choose_pieces(n_tiles);
  auto* places = workspace.allocate<int64_t>(n_tiles * pieces);
  std::vector<std::vector<Span>> spans(pieces);
  parallel_pieces(in.n_splats, pieces, [&](int piece, int64_t begin, int64_t end) {
    int64_t* counts = places + n_tiles * piece;
    std::fill_n(counts, n_tiles, 0);
    spans[piece].reserve(2 * (end - begin));
    for (int64_t i = begin; i < end; ++i) {
      // Splats in depth order are scattered in memory, so a few splats are prefetched.
      const int64_t ahead = splats[std::min(i + 8, end - 1)].splat;
      __builtin_prefetch(in.means2d + 2 * ahead);
      __builtin_prefetch(in.conics + 3 * ahead);
      __builtin_prefetch(in.opacities + ahead);
      __builtin_prefetch(in.camera_ids + ahead);
      for_each_span(in, splats[i].splat, [&](int64_t first, int32_t count) {
        spans[piece].push_back({splats[i].splat, count, first});
        for (int32_t tile = 0; tile < count; ++tile) ++counts[first + tile];
      });
    }
  });

  // The prefix sums of these counts are the positions of each piece in each list.
  int64_t place = 0;
  std::fill_n(tile_offsets, grid.tile_begin, 0);
  for (int64_t tile = 0; tile < n_tiles; ++tile) {
    tile_offsets[grid.tile_begin + tile] = place;
    for (int piece = 0; piece < pieces; ++piece) {
      const int64_t count = places[n_tiles * piece + tile];
      places[n_tiles * piece + tile] = place;
      place += count;
    }
  }
  std::fill_n(tile_offsets + grid.tile_end, grid.count() + 1 - grid.tile_end, place);
  if (place > capacity) return place;

  // Then each piece writes its part of every list.
  parallel_rows(pieces, 1, [&](int64_t piece) {
    int64_t* next = places + n_tiles * piece;
    for (const Span& span : spans[piece]) {
      for (int32_t tile = 0; tile < span.count; ++tile) isect_splats[next[span.first + tile]++] = span.splat;
    }
  });
  return place;
}

BLITZGS_FOR_BOTH_DTYPES(count_intersections);
BLITZGS_FOR_BOTH_DTYPES(intersect);

}  // namespace blitzgs::cpu
