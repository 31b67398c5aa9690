// SPDX-License-Identifier: Apache-2.0
#ifdef BLITZGS_BACKEND_CUDA
#include "common/op.h"
#include "exchange/copy_to_host.h"
#include "exchange/peers_op.h"

namespace blitzgs {
namespace {

void device_barrier(std::vector<Tensor> control, std::int64_t rank, std::int64_t number,
                    const std::optional<Tensor>& values, std::int64_t first, double timeout_seconds,
                    std::optional<Tensor> host) {
  constexpr const char* kOp = "device_barrier_";
  check_peers(kOp, control, ScalarType::Long);
  const auto count = static_cast<std::int64_t>(control.size());
  STD_TORCH_CHECK(rank >= 0 && rank < count, "blitzgs::", kOp, ": rank must be in [0, ", count, "), got ",
                  rank);
  std::int64_t n_values = 0;
  if (values) {
    check_in_place(kOp, "values", *values, ScalarType::Long, {-1});
    n_values = values->size(0);
  }
  STD_TORCH_CHECK(first >= count && first + (count + 1) * n_values <= control[0].size(0), "blitzgs::", kOp,
                  ": ", n_values, " values of ", count, " ranks and their sums from word ", first,
                  " on do not fit behind ", count, " words into ", control[0].size(0));
  if (host) check_host_values(kOp, *host, {count, n_values});
  ControlWords words{};
  words.count = static_cast<int>(count);
  words.rank = static_cast<int>(rank);
  for (std::int64_t m = 0; m < count; ++m) words.of[m] = mutable_data<std::int64_t>(control[m]);
  DeviceScope scope(control[rank]);
  cuda::device_barrier(words, number, data_or_null<std::int64_t>(values), static_cast<int>(n_values), first,
                       timeout_seconds, host ? mutable_data<std::int64_t>(*host) : nullptr, scope.workspace,
                       scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("device_barrier_", TORCH_BOX(&blitzgs::device_barrier)); }
#endif
