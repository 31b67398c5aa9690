// SPDX-License-Identifier: Apache-2.0
#include "report/report.h"

#include "common/op.h"

namespace blitzgs {
namespace {

void report_(const std::optional<Tensor>& parts_in, const std::optional<Tensor>& tile_work_in,
             std::int64_t tile_begin, std::int64_t tile_end, std::int64_t rank, std::int64_t n_ranks,
             std::vector<Tensor> targets) {
  constexpr const char* kOp = "report_";
  Report<float> report{};
  std::optional<Tensor> parts, tile_work;
  if (parts_in) {
    check_shape(kOp, "parts", *parts_in, {-1, -1, 2});
    check_dtype(kOp, "parts", *parts_in, ScalarType::Double);
    parts = as_contiguous(*parts_in);
    report.views = parts->size(0);
    report.n_parts = parts->size(1);
    report.parts = data<double>(*parts);
  }
  std::int64_t tiles = 0;
  if (tile_work_in) {
    check_shape(kOp, "tile_work", *tile_work_in, {-1});
    check_dtype(kOp, "tile_work", *tile_work_in, ScalarType::Int);
    tile_work = as_contiguous(*tile_work_in);
    tiles = tile_work->size(0);
    report.tile_work = data<std::int32_t>(*tile_work);
  }
  STD_TORCH_CHECK(0 <= tile_begin && tile_begin <= tile_end && tile_end <= tiles, "blitzgs::", kOp,
                  ": tile_begin and tile_end must be a range of the ", tiles, " tiles, got [", tile_begin,
                  ", ", tile_end, ")");
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
