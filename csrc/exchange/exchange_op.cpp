// SPDX-License-Identifier: Apache-2.0
#include "common/op.h"
#include "exchange/scatter.h"
#include "exchange/tile_costs.h"
#include "exchange/transport.h"
#include "project/project.h"

namespace blitzgs {
namespace {

SplatGroups checked_groups(const IntList& sizes) {
  const auto count = int64_t(sizes.size());
  BLITZGS_CHECK(count >= 1 && count <= kMaxRanks, "group_sizes must have 1 to ", kMaxRanks, " entries, got ",
                count);
  SplatGroups groups{};
  groups.count = int(count);
  int64_t splats = 0;
  for (int64_t m = 0; m < count; ++m) {
    BLITZGS_CHECK(sizes[m] >= 0 && sizes[m] <= INT32_MAX, "group_sizes must be in [0, 2^31), got ", sizes[m]);
    groups.size[m] = sizes[m];
    groups.start[m] = splats;
    splats += sizes[m];
  }
  return groups;
}

int64_t total_splats(const SplatGroups& groups) {
  return groups.start[groups.count - 1] + groups.size[groups.count - 1];
}

template <class Word> void add_column(SplatColumns<Word>& columns, Word* data, int64_t width) {
  BLITZGS_CHECK(columns.count < kMaxSplatColumns, "at most ", kMaxSplatColumns, " columns");
  const int64_t end = columns.begin[columns.count] + width;
  BLITZGS_CHECK(width >= 0 && end <= 4096, "a splat may have 4096 words, got ", end);
  columns.data[columns.count] = data;
  columns.begin[++columns.count] = int(end);
}

// Makes a column of `splats` splats for each of the widths and appends it.
template <class Word>
TensorList make_columns(SplatColumns<Word>& columns, const Tensor& like, int64_t splats,
                        const IntList& widths) {
  TensorList found;
  for (const int64_t width : widths) {
    BLITZGS_CHECK(width >= 0, "widths must not be negative, got ", width);
    const auto column = make<Word>(like, {splats, width});
    found.push_back(column);
    add_column(columns, column.data(), width);
  }
  return found;
}

SplatPlace* places_of(const Values<int64_t>& places) {
  static_assert(sizeof(SplatPlace) == sizeof(int64_t));
  return reinterpret_cast<SplatPlace*>(places.data());
}

// columns: int32 [P, w]; masks: int64 [P].
Tensors<2> scatter_splats(const TensorList& columns, const Tensor& masks_in, const IntList& group_sizes) {
  const auto masks = checked<int64_t>("masks", masks_in, {-1});
  ScatterSplats splats{{}, masks, masks.size(0)};
  BLITZGS_CHECK(splats.count <= INT32_MAX, splats.count,
                " splats exceed 2^31 - 1; project fewer views at a time");
  std::vector<Values<const int32_t>> held;
  for (const Tensor& column : columns) {
    held.push_back(checked<int32_t>("a column", column, {splats.count, -1}));
    add_column(splats.columns, held.back().data(), column.size(1));
  }
  const SplatGroups groups = checked_groups(group_sizes);
  const int64_t words = splats.columns.begin[splats.columns.count];
  const auto packed = make<int32_t>(masks, {total_splats(groups) * words});
  const auto places = make<int64_t>(masks, {place_runs(splats.count), groups.count});
  ScatterTargets targets{};
  for (int m = 0; m < groups.count; ++m) {
    for (int c = 0; c < splats.columns.count; ++c) {
      targets.words[m][c] = packed + groups.start[m] * words + groups.size[m] * splats.columns.begin[c];
    }
  }
  DeviceScope scope(masks);
  backend::scatter(splats, groups, targets, places_of(places), scope.workspace, scope.stream);
  return {packed, places};
}

TensorList gather_splats(const Tensor& packed, const IntList& widths, const IntList& group_sizes) {
  const SplatGroups groups = checked_groups(group_sizes);
  const int64_t n_splats = total_splats(groups);
  SplatColumns<int32_t> columns{};
  TensorList found = make_columns(columns, packed, n_splats, widths);
  const auto words = checked<int32_t>("packed", packed, {n_splats * columns.begin[columns.count]});
  DeviceScope scope(words);
  if (columns.count > 0) backend::gather(words, groups, columns, scope.stream);
  return found;
}

TensorList sum_splats(const TensorList& values, const Tensor& places_in, int64_t splats,
                      const IntList& widths) {
  BLITZGS_CHECK(splats >= 0, "splats must not be negative, got ", splats);
  const auto n_ranks = int64_t(values.size());
  BLITZGS_CHECK(n_ranks >= 1 && n_ranks <= kMaxRanks, "values must have 1 to ", kMaxRanks, " entries, got ",
                n_ranks);
  check_floating("values", values[0]);
  const auto places = checked<int64_t>("places", places_in, {place_runs(splats), n_ranks});
  DeviceScope scope(values[0]);
  return dispatch_floating(values[0], [&]<class T>() {
    SplatColumns<T> columns{};
    TensorList sums = make_columns(columns, values[0], splats, widths);
    SplatValues<T> in{};
    in.n_ranks = int(n_ranks);
    in.width = columns.begin[columns.count];
    in.count = splats;
    in.places = reinterpret_cast<const SplatPlace*>(places.data());
    std::vector<Values<const T>> held;
    for (int64_t m = 0; m < n_ranks; ++m) {
      held.push_back(checked<T>("values of a rank", values[m], {-1, in.width}));
      in.values[m] = held.back();
      in.size[m] = held.back().size(0);
    }
    backend::sum(in, columns, scope.stream);
    return sums;
  });
}

#ifdef BLITZGS_BACKEND_CUDA

// Checks that there is one buffer for each rank and that all have the same length and dtype.
void check_peers(const TensorList& buffers, ScalarType dtype) {
  const auto count = int64_t(buffers.size());
  BLITZGS_CHECK(count >= 1 && count <= kMaxPeers, "1 to ", kMaxPeers, " peers are supported, got ", count);
  for (const Tensor& buffer : buffers) check_in_place("a buffer", buffer, dtype, {buffers[0].size(0)});
}

void device_barrier(const TensorList& control, int64_t rank, int64_t number, const OptionalTensor& values,
                    int64_t first, double timeout_seconds, const OptionalTensor& host) {
  check_peers(control, ScalarType::Long);
  const auto count = int64_t(control.size());
  BLITZGS_CHECK(rank >= 0 && rank < count, "rank must be in [0, ", count, "), got ", rank);
  if (values) check_in_place("values", *values, ScalarType::Long, {-1});
  const int64_t n_values = values ? values->size(0) : 0;
  BLITZGS_CHECK(first >= count && first + (count + 1) * n_values <= control[0].size(0), n_values,
                " values of ", count, " ranks and their sums from word ", first, " on do not fit behind ",
                count, " words into ", control[0].size(0));
  if (host) check_host_values(*host, {count, n_values});
  ControlWords words{};
  words.count = int(count);
  words.rank = int(rank);
  for (int64_t m = 0; m < count; ++m) words.of[m] = mutable_data<int64_t>(control[m]);
  DeviceScope scope(control[rank]);
  cuda::device_barrier(words, number, data_or_null<int64_t>(values), int(n_values), first, timeout_seconds,
                       host ? mutable_data<int64_t>(*host) : nullptr, scope.stream);
}

void copy_to_host(const Tensor& host, const Tensor& values_in) {
  const auto values = checked_in_place<int64_t>("values", values_in, {-1});
  BLITZGS_CHECK(!values.is_cpu(), "values must be on the GPU");
  check_host_values(host, {values.size(0)});
  DeviceScope scope(values);
  cuda::copy_to_host(values, values.size(0), mutable_data<int64_t>(host), scope.stream);
}

// Returns the places and the SendPlan, whose first word is the number of splats that this rank receives.
Tensors<2> send_splats(const TensorList& columns, const Tensor& rank_masks, const Tensor& everyone,
                       int64_t rank, const TensorList& buffers, int64_t capacity) {
  const auto n_ranks = int64_t(buffers.size());
  BLITZGS_CHECK(columns.size() == size_t(kSentColumns.count),
                "columns must be means2d, conics, opacities, colors, depths, camera_ids and ids, got ",
                columns.size());
  BLITZGS_CHECK(columns[0].size(0) >= capacity, "columns must have room for ", capacity, " splats, got ",
                columns[0].size(0));
  SendArguments arguments{};
  check_peers(buffers, ScalarType::Int);
  BLITZGS_CHECK(capacity >= 0 && capacity <= INT32_MAX &&
                    capacity * kSentColumns.begin[kSentColumns.count] <= buffers[0].size(0),
                capacity, " splats do not fit into a buffer of ", buffers[0].size(0), " words");
  for (int m = 0; m < n_ranks; ++m) {
    for (int c = 0; c < kSentColumns.count; ++c) {
      arguments.targets.words[m][c] = mutable_data<int32_t>(buffers[m]) + capacity * kSentColumns.begin[c];
    }
  }
  arguments.splats.columns = kSentColumns;
  arguments.splats.count = capacity;
  for (int c = 0; c < kSentColumns.count; ++c) {
    const Tensor& column = columns[c];
    const int64_t words = kSentColumns.begin[c + 1] - kSentColumns.begin[c];
    BLITZGS_CHECK(column.is_contiguous() && column.size(0) == columns[0].size(0) &&
                      column.numel() * int64_t(column.element_size()) == 4 * words * column.size(0),
                  "column ", c, " must be contiguous, of ", words, " words a splat");
    arguments.splats.columns.data[c] = static_cast<const int32_t*>(column.const_data_ptr());
  }
  arguments.splats.masks = checked_in_place<int64_t>("rank_masks", rank_masks, {columns[0].size(0)});
  arguments.everyone = checked_in_place<int64_t>("everyone", everyone, {n_ranks, -1});
  const int64_t n_views = everyone.size(1) - project_totals(0, n_ranks);
  BLITZGS_CHECK(!everyone.is_cpu() && n_views >= 0 && rank >= 0 && rank < n_ranks,
                "everyone must be on the GPU and the totals of ", n_ranks,
                " ranks, and rank one of them, got ", rank);
  DeviceScope scope(columns[0]);
  const auto places = make<int64_t>(columns[0], {place_runs(capacity), n_ranks}),
             plan = make<int64_t>(columns[0], {(sizeof(SendPlan) + 7) / 8});
  arguments.plan = reinterpret_cast<SendPlan*>(plan.data());
  arguments.places = places_of(places);
  arguments.n_views = int(n_views);
  arguments.n_ranks = int(n_ranks);
  arguments.rank = int(rank);
  cuda::send_splats(arguments, scope.stream);
  return {places, plan};
}

#else

// The costs are in the memory of the host for every device that renders.

TensorList tile_costs(const Tensor& sums_in, int64_t first, int64_t views, int64_t grain) {
  const auto sums = checked_in_place<float>("sums", sums_in, {-1});
  BLITZGS_CHECK(first >= 0 && first <= sums.size(0), "first must be in [0, ", sums.size(0), "], got ", first);
  const int64_t costs = sums.size(0) - first;
  BLITZGS_CHECK(views > 0 && costs % views == 0, costs, " costs are not those of the tiles of ", views,
                " views of one size");
  BLITZGS_CHECK(grain > 0, "grain must be at least 1, got ", grain);
  const int64_t tiles = costs / views, pieces = (tiles + grain - 1) / grain;
  TensorList stored;
  for (int64_t view = 0; view < views; ++view) {
    stored.push_back(make_empty(sums, {pieces}, ScalarType::Half));
    cpu::store_tile_costs(sums + first + view * tiles, tiles, grain, mutable_data<uint16_t>(stored.back()));
  }
  return stored;
}

// Checks the pieces of views and returns their addresses, null for an empty tensor.
std::vector<const uint16_t*> checked_pieces(const char* name, const TensorList& views, int64_t pieces,
                                            bool may_be_empty) {
  std::vector<const uint16_t*> found;
  for (const Tensor& view : views) {
    const bool empty = may_be_empty && view.numel() == 0;
    check_in_place(name, view, ScalarType::Half, {empty ? 0 : pieces});
    found.push_back(empty ? nullptr : data<uint16_t>(view));
  }
  return found;
}

IntList divide_tiles(const TensorList& costs, const TensorList& similar, int64_t tiles, int64_t grain,
                     double tile_cost, int64_t parts) {
  BLITZGS_CHECK(!costs.empty(), "there must be views");
  BLITZGS_CHECK(tiles > 0 && grain > 0, "tiles and grain must be at least 1, got ", tiles, " and ", grain);
  BLITZGS_CHECK(parts > 0 && parts <= (1 << 20), "parts must be 1 to 2^20, got ", parts);
  BLITZGS_CHECK(tile_cost >= 8, "sums are exact for a tile_cost from 8 on, got ", tile_cost);
  const int64_t pieces = (tiles + grain - 1) / grain;
  const auto views = checked_pieces("costs of a view", costs, pieces, true);
  const auto alike = checked_pieces("costs of a similar view", similar, pieces, false);
  IntList bounds(parts + 1);
  DeviceScope scope(costs[0]);
  cpu::divide_tiles({views.data(), int64_t(views.size()), alike.data(), int64_t(alike.size()), tiles, grain,
                     float(tile_cost)},
                    parts, scope.workspace, bounds.data());
  return bounds;
}

#endif

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  BLITZGS_OP(m, "scatter_splats", scatter_splats);
  BLITZGS_OP(m, "gather_splats", gather_splats);
  BLITZGS_OP(m, "sum_splats", sum_splats);
#ifdef BLITZGS_BACKEND_CUDA
  BLITZGS_OP(m, "device_barrier_", device_barrier);
  BLITZGS_OP(m, "copy_to_host_", copy_to_host);
  BLITZGS_OP(m, "send_splats_", send_splats);
#else
  BLITZGS_OP(m, "tile_costs", tile_costs);
  BLITZGS_OP(m, "divide_tiles", divide_tiles);
#endif
}
