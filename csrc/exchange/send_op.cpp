// SPDX-License-Identifier: Apache-2.0
#ifdef BLITZGS_BACKEND_CUDA
#include <tuple>

#include "exchange/peers_op.h"

namespace blitzgs {
namespace {

// Returns the places and the SendPlan, whose first word is the number of splats that this rank receives.
std::tuple<Tensor, Tensor> send_splats(const std::vector<Tensor>& columns, const Tensor& rank_masks,
                                       const Tensor& everyone, std::int64_t rank, std::vector<Tensor> buffers,
                                       std::int64_t capacity) {
  constexpr const char* kOp = "send_splats_";
  const auto n_ranks = static_cast<std::int64_t>(buffers.size());
  STD_TORCH_CHECK(columns.size() == static_cast<std::size_t>(kSentColumns.count), "blitzgs::", kOp,
                  ": columns must be means2d, conics, opacities, colors, depths, camera_ids and ids, got ",
                  columns.size());
  STD_TORCH_CHECK(columns[0].size(0) >= capacity, "blitzgs::", kOp, ": columns must have room for ", capacity,
                  " splats, got ", columns[0].size(0));
  SendArguments arguments{};
  arguments.targets = peer_targets(kOp, buffers, kSentColumns, capacity, static_cast<int>(n_ranks));
  arguments.splats.columns = kSentColumns;
  arguments.splats.count = capacity;
  for (int c = 0; c < kSentColumns.count; ++c) {
    const Tensor& column = columns[c];
    const std::int64_t words = kSentColumns.begin[c + 1] - kSentColumns.begin[c];
    STD_TORCH_CHECK(
        column.is_contiguous() && column.size(0) == columns[0].size(0) &&
            column.numel() * static_cast<std::int64_t>(column.element_size()) == 4 * words * column.size(0),
        "blitzgs::", kOp, ": column ", c, " must be contiguous, of ", words, " words a splat");
    arguments.splats.columns.data[c] = static_cast<const std::int32_t*>(column.const_data_ptr());
  }
  check_in_place(kOp, "rank_masks", rank_masks, ScalarType::Long, {columns[0].size(0)});
  arguments.splats.masks = data<std::int64_t>(rank_masks);
  check_in_place(kOp, "everyone", everyone, ScalarType::Long, {n_ranks, -1});
  const std::int64_t n_views = everyone.size(1) - project_totals(0, n_ranks);
  STD_TORCH_CHECK(!everyone.is_cpu() && n_views >= 0 && rank >= 0 && rank < n_ranks, "blitzgs::", kOp,
                  ": everyone must be on the GPU and the totals of ", n_ranks,
                  " ranks, and rank one of them, got ", rank);
  DeviceScope scope(columns[0]);
  Tensor places = make_places(columns[0], capacity, n_ranks);
  Tensor plan = make_empty(columns[0], {(sizeof(SendPlan) + 7) / 8}, ScalarType::Long);
  arguments.plan = reinterpret_cast<SendPlan*>(mutable_data<std::int64_t>(plan));
  arguments.places = places_of(places);
  arguments.everyone = data<std::int64_t>(everyone);
  arguments.n_views = static_cast<int>(n_views);
  arguments.n_ranks = static_cast<int>(n_ranks);
  arguments.rank = static_cast<int>(rank);
  cuda::send_splats(arguments, scope.stream);
  return {places, plan};
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("send_splats_", TORCH_BOX(&blitzgs::send_splats)); }
#endif
