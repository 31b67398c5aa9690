// SPDX-License-Identifier: Apache-2.0
#include "loss/report.h"

#include "common/op.h"

namespace blitzgs {
namespace {

void report_(const std::optional<Tensor>& parts_in, const std::optional<Tensor>& tile_work_in,
             std::int64_t tile_begin, std::int64_t tile_end, std::int64_t rank, std::int64_t n_ranks,
             std::vector<Tensor> targets) {
  constexpr const char* kOp = "report_";
  Report<float> report{};
  const auto parts = checked(kOp, "parts", parts_in, ScalarType::Double, {-1, -1, 2});
  if (parts) {
    report.views = parts->size(0);
    report.n_parts = parts->size(1);
    report.parts = data<double>(*parts);
  }
  const auto tile_work = checked(kOp, "tile_work", tile_work_in, ScalarType::Int, {-1});
  report.tile_work = data_or_null<std::int32_t>(tile_work);
  const std::int64_t tiles = tile_work ? tile_work->size(0) : 0;
  check_tile_range(kOp, tile_begin, tile_end, tiles);
  report.tile_begin = tile_begin;
  report.tile_end = tile_end;
  STD_TORCH_CHECK(rank >= 0 && rank < n_ranks, "blitzgs::", kOp, ": rank must be in [0, ", n_ranks, "), got ",
                  rank);
  const auto count = static_cast<std::int64_t>(targets.size());
  STD_TORCH_CHECK(count > 0 && count <= kMaxReportTargets, "blitzgs::", kOp, ": 1 to ", kMaxReportTargets,
                  " targets are supported, got ", count);
  for (Tensor& target : targets) {
    check_in_place(kOp, "a target", target, ScalarType::Float, {2 * report.views * n_ranks + tiles});
    float* sums = mutable_data<float>(target);
    float* mine = sums + 2 * report.views * rank;
    report.targets[report.n_targets++] = {mine, mine + report.views, sums + 2 * report.views * n_ranks};
  }
  DeviceScope scope(parts ? *parts : tile_work ? *tile_work : targets[0]);
  backend::report(report, scope.workspace, scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("report_", TORCH_BOX(&blitzgs::report_)); }
