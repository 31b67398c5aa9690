// SPDX-License-Identifier: Apache-2.0
#include <tuple>

#include "common/op.h"
#include "exchange/scatter.h"
#include "exchange/tile_costs.h"
#include "exchange/transport.h"
#include "project/project.h"

namespace blitzgs {
namespace {

SplatGroups checked_groups(const char* op, const char* name, const std::vector<std::int64_t>& sizes) {
  const auto count = static_cast<std::int64_t>(sizes.size());
  BLITZGS_CHECK(count >= 1 && count <= kMaxRanks, op, name, " must have 1 to ", kMaxRanks, " entries, got ",
                count);
  SplatGroups groups{};
  groups.count = static_cast<int>(count);
  std::int64_t splats = 0;
  for (std::int64_t m = 0; m < count; ++m) {
    BLITZGS_CHECK(sizes[m] >= 0 && sizes[m] <= std::numeric_limits<std::int32_t>::max(), op, name,
                  " must be in [0, 2^31), got ", sizes[m]);
    groups.size[m] = sizes[m];
    groups.start[m] = splats;
    splats += sizes[m];
  }
  return groups;
}

std::int64_t total_splats(const SplatGroups& groups) {
  return groups.start[groups.count - 1] + groups.size[groups.count - 1];
}

// Appends a column with `width` words per splat.
template <class Word>
void add_column(const char* op, SplatColumns<Word>& columns, Word* data, std::int64_t width) {
  BLITZGS_CHECK(columns.count < kMaxSplatColumns, op, "at most ", kMaxSplatColumns, " columns");
  const std::int64_t end = columns.begin[columns.count] + width;
  BLITZGS_CHECK(width >= 0 && end <= 4096, op, "a splat may have 4096 words, got ", end);
  columns.data[columns.count] = data;
  columns.begin[++columns.count] = static_cast<int>(end);
}

// Makes a column of `splats` splats for each of the widths and appends it.
template <class Word>
std::vector<Tensor> make_columns(const char* op, SplatColumns<Word>& columns, const Tensor& like,
                                 std::int64_t splats, const std::vector<std::int64_t>& widths) {
  std::vector<Tensor> found;
  for (const std::int64_t width : widths) {
    BLITZGS_CHECK(width >= 0, op, "widths must not be negative, got ", width);
    const auto column = make<Word>(like, {splats, width});
    found.push_back(column);
    add_column(op, columns, column.data(), width);
  }
  return found;
}

// Columns int32 [P, w] and masks int64 [P]; keeps the contiguous forms alive.
struct HeldSplats {
  HeldSplats(const char* op, const std::vector<Tensor>& columns, const Tensor& masks_in)
      : masks(checked<std::int64_t>(op, "masks", masks_in, {-1})) {
    splats.masks = masks;
    splats.count = masks.size(0);
    BLITZGS_CHECK(splats.count <= std::numeric_limits<std::int32_t>::max(), op, splats.count,
                  " splats exceed 2^31 - 1; project fewer views at a time");
    for (const Tensor& column : columns) {
      held.push_back(checked<std::int32_t>(op, "a column", column, {splats.count, -1}));
      add_column(op, splats.columns, held.back().data(), column.size(1));
    }
  }

  Values<const std::int64_t> masks;
  std::vector<Values<const std::int32_t>> held;
  ScatterSplats splats{};
};

SplatPlace* places_of(const Values<std::int64_t>& places) {
  static_assert(sizeof(SplatPlace) == sizeof(std::int64_t));
  return reinterpret_cast<SplatPlace*>(places.data());
}

std::tuple<Tensor, Tensor> scatter_splats(const std::vector<Tensor>& columns, const Tensor& masks,
                                          const std::vector<std::int64_t>& group_sizes) {
  constexpr const char* kOp = "scatter_splats";
  HeldSplats held(kOp, columns, masks);
  const SplatGroups groups = checked_groups(kOp, "group_sizes", group_sizes);
  const auto& columns_in = held.splats.columns;
  const std::int64_t words = columns_in.begin[columns_in.count];
  const auto packed = make<std::int32_t>(held.masks, {total_splats(groups) * words});
  const auto places = make<std::int64_t>(held.masks, {place_runs(held.splats.count), groups.count});
  ScatterTargets targets{};
  for (int m = 0; m < groups.count; ++m) {
    for (int c = 0; c < columns_in.count; ++c) {
      targets.words[m][c] = packed + groups.start[m] * words + groups.size[m] * columns_in.begin[c];
    }
  }
  DeviceScope scope(held.masks);
  backend::scatter(held.splats, groups, targets, places_of(places), scope.workspace, scope.stream);
  return {packed, places};
}

std::vector<Tensor> gather_splats(const Tensor& packed, const std::vector<std::int64_t>& widths,
                                  const std::vector<std::int64_t>& group_sizes) {
  constexpr const char* kOp = "gather_splats";
  const SplatGroups groups = checked_groups(kOp, "group_sizes", group_sizes);
  const std::int64_t n_splats = total_splats(groups);
  SplatColumns<std::int32_t> columns{};
  std::vector<Tensor> found = make_columns(kOp, columns, packed, n_splats, widths);
  const auto words = checked<std::int32_t>(kOp, "packed", packed, {n_splats * columns.begin[columns.count]});
  DeviceScope scope(words);
  if (columns.count > 0) backend::gather(words, groups, columns, scope.stream);
  return found;
}

std::vector<Tensor> sum_splats(const std::vector<Tensor>& values, const Tensor& places_in,
                               std::int64_t splats, const std::vector<std::int64_t>& widths) {
  constexpr const char* kOp = "sum_splats";
  BLITZGS_CHECK(splats >= 0, kOp, "splats must not be negative, got ", splats);
  const auto n_ranks = static_cast<std::int64_t>(values.size());
  BLITZGS_CHECK(n_ranks >= 1 && n_ranks <= kMaxRanks, kOp, "values must have 1 to ", kMaxRanks,
                " entries, got ", n_ranks);
  check_floating(kOp, "values", values[0]);
  const auto places = checked<std::int64_t>(kOp, "places", places_in, {place_runs(splats), n_ranks});
  DeviceScope scope(values[0]);
  return dispatch_floating(values[0], [&]<class T>() {
    SplatColumns<T> columns{};
    std::vector<Tensor> sums = make_columns(kOp, columns, values[0], splats, widths);
    SplatValues<T> in{};
    in.n_ranks = static_cast<int>(n_ranks);
    in.width = columns.begin[columns.count];
    in.count = splats;
    in.places = reinterpret_cast<const SplatPlace*>(places.data());
    std::vector<Values<const T>> held;
    for (std::int64_t m = 0; m < n_ranks; ++m) {
      held.push_back(checked<T>(kOp, "values of a rank", values[m], {-1, in.width}));
      in.values[m] = held.back();
      in.size[m] = held.back().size(0);
    }
    backend::sum(in, columns, scope.stream);
    return sums;
  });
}

#ifdef BLITZGS_BACKEND_CUDA

// Checks that there is one buffer for each rank and that all have the same length and dtype.
void check_peers(const char* op, const std::vector<Tensor>& buffers, ScalarType dtype) {
  const auto count = static_cast<std::int64_t>(buffers.size());
  BLITZGS_CHECK(count >= 1 && count <= kMaxPeers, op, "1 to ", kMaxPeers, " peers are supported, got ",
                count);
  for (const Tensor& buffer : buffers) {
    check_in_place(op, "a buffer", buffer, dtype, {buffers[0].size(0)});
  }
}

// The addresses of the columns in each rank's buffer, for columns with a capacity of `capacity` splats.
template <class Word>
ScatterTargets peer_targets(const char* op, const std::vector<Tensor>& buffers,
                            const SplatColumns<Word>& columns, std::int64_t capacity, int n_ranks) {
  check_peers(op, buffers, ScalarType::Int);
  BLITZGS_CHECK(static_cast<int>(buffers.size()) == n_ranks, op, n_ranks, " ranks need as many buffers, got ",
                buffers.size());
  BLITZGS_CHECK(capacity >= 0 && capacity <= std::numeric_limits<std::int32_t>::max() &&
                    capacity * columns.begin[columns.count] <= buffers[0].size(0),
                op, "", capacity, " splats do not fit into a buffer of ", buffers[0].size(0), " words");
  ScatterTargets targets{};
  for (int m = 0; m < n_ranks; ++m) {
    for (int c = 0; c < columns.count; ++c) {
      targets.words[m][c] = mutable_data<std::int32_t>(buffers[m]) + capacity * columns.begin[c];
    }
  }
  return targets;
}

void device_barrier(const std::vector<Tensor>& control, std::int64_t rank, std::int64_t number,
                    const std::optional<Tensor>& values, std::int64_t first, double timeout_seconds,
                    const std::optional<Tensor>& host) {
  constexpr const char* kOp = "device_barrier_";
  check_peers(kOp, control, ScalarType::Long);
  const auto count = static_cast<std::int64_t>(control.size());
  BLITZGS_CHECK(rank >= 0 && rank < count, kOp, "rank must be in [0, ", count, "), got ", rank);
  if (values) check_in_place(kOp, "values", *values, ScalarType::Long, {-1});
  const std::int64_t n_values = values ? values->size(0) : 0;
  BLITZGS_CHECK(first >= count && first + (count + 1) * n_values <= control[0].size(0), kOp, n_values,
                " values of ", count, " ranks and their sums from word ", first, " on do not fit behind ",
                count, " words into ", control[0].size(0));
  if (host) check_host_values(kOp, *host, {count, n_values});
  ControlWords words{};
  words.count = static_cast<int>(count);
  words.rank = static_cast<int>(rank);
  for (std::int64_t m = 0; m < count; ++m) words.of[m] = mutable_data<std::int64_t>(control[m]);
  DeviceScope scope(control[rank]);
  cuda::device_barrier(words, number, data_or_null<std::int64_t>(values), static_cast<int>(n_values), first,
                       timeout_seconds, host ? mutable_data<std::int64_t>(*host) : nullptr, scope.stream);
}

void copy_to_host(const Tensor& host, const Tensor& values_in) {
  constexpr const char* kOp = "copy_to_host_";
  const auto values = checked_in_place<std::int64_t>(kOp, "values", values_in, {-1});
  BLITZGS_CHECK(!values.is_cpu(), kOp, "values must be on the GPU");
  check_host_values(kOp, host, {values.size(0)});
  DeviceScope scope(values);
  cuda::copy_to_host(values, values.size(0), mutable_data<std::int64_t>(host), scope.stream);
}

// Returns the places and the SendPlan, whose first word is the number of splats that this rank receives.
std::tuple<Tensor, Tensor> send_splats(const std::vector<Tensor>& columns, const Tensor& rank_masks,
                                       const Tensor& everyone, std::int64_t rank,
                                       const std::vector<Tensor>& buffers, std::int64_t capacity) {
  constexpr const char* kOp = "send_splats_";
  const auto n_ranks = static_cast<std::int64_t>(buffers.size());
  BLITZGS_CHECK(columns.size() == static_cast<std::size_t>(kSentColumns.count), kOp,
                "columns must be means2d, conics, opacities, colors, depths, camera_ids and ids, got ",
                columns.size());
  BLITZGS_CHECK(columns[0].size(0) >= capacity, kOp, "columns must have room for ", capacity, " splats, got ",
                columns[0].size(0));
  SendArguments arguments{};
  arguments.targets = peer_targets(kOp, buffers, kSentColumns, capacity, static_cast<int>(n_ranks));
  arguments.splats.columns = kSentColumns;
  arguments.splats.count = capacity;
  for (int c = 0; c < kSentColumns.count; ++c) {
    const Tensor& column = columns[c];
    const std::int64_t words = kSentColumns.begin[c + 1] - kSentColumns.begin[c];
    BLITZGS_CHECK(
        column.is_contiguous() && column.size(0) == columns[0].size(0) &&
            column.numel() * static_cast<std::int64_t>(column.element_size()) == 4 * words * column.size(0),
        kOp, "column ", c, " must be contiguous, of ", words, " words a splat");
    arguments.splats.columns.data[c] = static_cast<const std::int32_t*>(column.const_data_ptr());
  }
  arguments.splats.masks =
      checked_in_place<std::int64_t>(kOp, "rank_masks", rank_masks, {columns[0].size(0)});
  arguments.everyone = checked_in_place<std::int64_t>(kOp, "everyone", everyone, {n_ranks, -1});
  const std::int64_t n_views = everyone.size(1) - project_totals(0, n_ranks);
  BLITZGS_CHECK(!everyone.is_cpu() && n_views >= 0 && rank >= 0 && rank < n_ranks, kOp,
                "everyone must be on the GPU and the totals of ", n_ranks,
                " ranks, and rank one of them, got ", rank);
  DeviceScope scope(columns[0]);
  const auto places = make<std::int64_t>(columns[0], {place_runs(capacity), n_ranks}),
             plan = make<std::int64_t>(columns[0], {(sizeof(SendPlan) + 7) / 8});
  arguments.plan = reinterpret_cast<SendPlan*>(plan.data());
  arguments.places = places_of(places);
  arguments.n_views = static_cast<int>(n_views);
  arguments.n_ranks = static_cast<int>(n_ranks);
  arguments.rank = static_cast<int>(rank);
  cuda::send_splats(arguments, scope.stream);
  return {places, plan};
}

#else

// The costs are in the memory of the host for every device that renders.

std::vector<Tensor> tile_costs(const Tensor& sums_in, std::int64_t first, std::int64_t views,
                               std::int64_t grain) {
  constexpr const char* kOp = "tile_costs";
  const auto sums = checked_in_place<float>(kOp, "sums", sums_in, {-1});
  BLITZGS_CHECK(first >= 0 && first <= sums.size(0), kOp, "first must be in [0, ", sums.size(0), "], got ",
                first);
  const std::int64_t costs = sums.size(0) - first;
  BLITZGS_CHECK(views > 0 && costs % views == 0, kOp, costs, " costs are not those of the tiles of ", views,
                " views of one size");
  BLITZGS_CHECK(grain > 0, kOp, "grain must be at least 1, got ", grain);
  const std::int64_t tiles = costs / views, pieces = (tiles + grain - 1) / grain;
  std::vector<Tensor> stored;
  for (std::int64_t view = 0; view < views; ++view) {
    stored.push_back(make_empty(sums, {pieces}, ScalarType::Half));
    cpu::store_tile_costs(sums + first + view * tiles, tiles, grain,
                          mutable_data<std::uint16_t>(stored.back()));
  }
  return stored;
}

// Checks the pieces of views and returns their addresses, null for an empty tensor.
std::vector<const std::uint16_t*> checked_pieces(const char* op, const char* name,
                                                 const std::vector<Tensor>& views, std::int64_t pieces,
                                                 bool may_be_empty) {
  std::vector<const std::uint16_t*> found;
  for (const Tensor& view : views) {
    const bool empty = may_be_empty && view.numel() == 0;
    check_in_place(op, name, view, ScalarType::Half, {empty ? 0 : pieces});
    found.push_back(empty ? nullptr : data<std::uint16_t>(view));
  }
  return found;
}

std::vector<std::int64_t> divide_tiles(const std::vector<Tensor>& costs, const std::vector<Tensor>& similar,
                                       std::int64_t tiles, std::int64_t grain, double tile_cost,
                                       std::int64_t parts) {
  constexpr const char* kOp = "divide_tiles";
  BLITZGS_CHECK(!costs.empty(), kOp, "there must be views");
  BLITZGS_CHECK(tiles > 0 && grain > 0, kOp, "tiles and grain must be at least 1, got ", tiles, " and ",
                grain);
  BLITZGS_CHECK(parts > 0 && parts <= (1 << 20), kOp, "parts must be 1 to 2^20, got ", parts);
  BLITZGS_CHECK(tile_cost >= 8, kOp, "sums are exact for a tile_cost from 8 on, got ", tile_cost);
  const std::int64_t pieces = (tiles + grain - 1) / grain;
  const auto views = checked_pieces(kOp, "costs of a view", costs, pieces, true);
  const auto alike = checked_pieces(kOp, "costs of a similar view", similar, pieces, false);
  std::vector<std::int64_t> bounds(parts + 1);
  DeviceScope scope(costs[0]);
  cpu::divide_tiles({views.data(), static_cast<std::int64_t>(views.size()), alike.data(),
                     static_cast<std::int64_t>(alike.size()), tiles, grain, static_cast<float>(tile_cost)},
                    parts, scope.workspace, bounds.data());
  return bounds;
}

#endif

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("scatter_splats", TORCH_BOX(&blitzgs::scatter_splats));
  m.impl("gather_splats", TORCH_BOX(&blitzgs::gather_splats));
  m.impl("sum_splats", TORCH_BOX(&blitzgs::sum_splats));
#ifdef BLITZGS_BACKEND_CUDA
  m.impl("device_barrier_", TORCH_BOX(&blitzgs::device_barrier));
  m.impl("copy_to_host_", TORCH_BOX(&blitzgs::copy_to_host));
  m.impl("send_splats_", TORCH_BOX(&blitzgs::send_splats));
#else
  m.impl("tile_costs", TORCH_BOX(&blitzgs::tile_costs));
  m.impl("divide_tiles", TORCH_BOX(&blitzgs::divide_tiles));
#endif
}
