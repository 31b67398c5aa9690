// SPDX-License-Identifier: Apache-2.0
#include "peers/peers_op.h"

#include "tell_host/tell_host_op.h"

#ifdef BLITZGS_BACKEND_CUDA
namespace blitzgs {
namespace {

void return_to_peers(const Tensor& values, std::int64_t width, const std::vector<std::int64_t>& group_sizes,
                     std::vector<Tensor> buffers, std::int64_t offset,
                     const std::vector<std::int64_t>& starts, std::int64_t rank,
                     const std::optional<Tensor>& fronts, bool back) {
  constexpr const char* kOp = "return_to_peers_";
  PeerReturn job{};
  job.groups = checked_groups(kOp, "group_sizes", group_sizes);
  check_dtype(kOp, "values", values, ScalarType::Float);
  check_shape(kOp, "values", values, {total_rows(job.groups), -1});
  STD_TORCH_CHECK(width > 0 && width <= values.size(1), "blitzgs::", kOp, ": width must be 1 to ",
                  values.size(1), ", got ", width);
  const Tensor held = as_contiguous(values);
  job.values = data<float>(held);
  job.stride = static_cast<int>(values.size(1));
  job.width = static_cast<int>(width);
  STD_TORCH_CHECK(!buffers.empty() && offset >= 0 && offset <= buffers[0].size(0), "blitzgs::", kOp,
                  ": offset must lie in the buffers, got ", offset);
  check_starts(kOp, buffers, starts, job.groups, (buffers[0].size(0) - offset) / width);
  for (int m = 0; m < job.groups.count; ++m) {
    job.targets[m] =
        reinterpret_cast<float*>(mutable_data<std::int32_t>(buffers[m]) + offset) + starts[m] * width;
  }
  if (fronts) {
    check_dtype(kOp, "fronts", *fronts, ScalarType::Long);
    check_shape(kOp, "fronts", *fronts, {job.groups.count});
    job.fronts = data<std::int64_t>(*fronts);
    job.fronts_stride = fronts->stride(0);
  }
  STD_TORCH_CHECK(fronts || !back, "blitzgs::", kOp, ": back needs fronts");
  STD_TORCH_CHECK(rank >= 0 && rank < job.groups.count, "blitzgs::", kOp, ": rank must be in [0, ",
                  job.groups.count, "), got ", rank);
  job.rank = static_cast<int>(rank);
  job.back = back;
  DeviceScope scope(held);
  cuda::return_rows(job, scope.workspace, scope.stream);
}

void meet_peers(std::vector<Tensor> mail, std::int64_t rank, std::int64_t meeting,
                const std::optional<Tensor>& values, std::int64_t first, double timeout_seconds,
                std::optional<Tensor> known) {
  constexpr const char* kOp = "meet_peers_";
  check_peers(kOp, mail, ScalarType::Long);
  const auto count = static_cast<std::int64_t>(mail.size());
  STD_TORCH_CHECK(rank >= 0 && rank < count, "blitzgs::", kOp, ": rank must be in [0, ", count, "), got ",
                  rank);
  std::int64_t n_values = 0;
  if (values) {
    check_shape(kOp, "values", *values, {-1});
    check_dtype(kOp, "values", *values, ScalarType::Long);
    STD_TORCH_CHECK(values->is_contiguous(), "blitzgs::", kOp, ": values must be contiguous");
    n_values = values->size(0);
  }
  STD_TORCH_CHECK(first >= count && first + (count + 1) * n_values <= mail[0].size(0), "blitzgs::", kOp, ": ",
                  n_values, " values of ", count, " ranks and their sums from word ", first,
                  " on do not fit behind ", count, " words into ", mail[0].size(0));
  if (known) check_host_values(kOp, *known, {count, n_values});
  PeerMail letters{};
  letters.count = static_cast<int>(count);
  letters.rank = static_cast<int>(rank);
  for (std::int64_t m = 0; m < count; ++m) letters.of[m] = mutable_data<std::int64_t>(mail[m]);
  DeviceScope scope(mail[rank]);
  cuda::meet(letters, meeting, data_or_null<std::int64_t>(values), static_cast<int>(n_values), first,
             timeout_seconds, known ? mutable_data<std::int64_t>(*known) : nullptr, scope.workspace,
             scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) {
  m.impl("return_to_peers_", TORCH_BOX(&blitzgs::return_to_peers));
  m.impl("meet_peers_", TORCH_BOX(&blitzgs::meet_peers));
}
#endif
