// SPDX-License-Identifier: Apache-2.0
#include "exchange/tile_costs.h"

#include "common/op.h"

// The costs are in the memory of the host for every device that renders.
#ifndef BLITZGS_BACKEND_CUDA
namespace blitzgs {
namespace {

std::vector<Tensor> tile_costs(const Tensor& sums, std::int64_t first, std::int64_t views,
                               std::int64_t grain) {
  constexpr const char* kOp = "tile_costs";
  check_in_place(kOp, "sums", sums, ScalarType::Float, {-1});
  STD_TORCH_CHECK(first >= 0 && first <= sums.size(0), "blitzgs::", kOp, ": first must be in [0, ",
                  sums.size(0), "], got ", first);
  const std::int64_t costs = sums.size(0) - first;
  STD_TORCH_CHECK(views > 0 && costs % views == 0, "blitzgs::", kOp, ": ", costs,
                  " costs are not those of the tiles of ", views, " views of one size");
  STD_TORCH_CHECK(grain > 0, "blitzgs::", kOp, ": grain must be at least 1, got ", grain);
  const std::int64_t tiles = costs / views, pieces = (tiles + grain - 1) / grain;
  std::vector<Tensor> stored;
  for (std::int64_t view = 0; view < views; ++view) {
    stored.push_back(make_empty(sums, {pieces}, ScalarType::Half));
    cpu::store_tile_costs(data<float>(sums) + first + view * tiles, tiles, grain,
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
  STD_TORCH_CHECK(!costs.empty(), "blitzgs::", kOp, ": there must be views");
  STD_TORCH_CHECK(tiles > 0 && grain > 0, "blitzgs::", kOp, ": tiles and grain must be at least 1, got ",
                  tiles, " and ", grain);
  STD_TORCH_CHECK(parts > 0 && parts <= (1 << 20), "blitzgs::", kOp, ": parts must be 1 to 2^20, got ",
                  parts);
  STD_TORCH_CHECK(tile_cost >= 8, "blitzgs::", kOp, ": sums are exact for a tile_cost from 8 on, got ",
                  tile_cost);
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

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("tile_costs", TORCH_BOX(&blitzgs::tile_costs));
  m.impl("divide_tiles", TORCH_BOX(&blitzgs::divide_tiles));
}
#endif
