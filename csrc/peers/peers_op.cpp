// SPDX-License-Identifier: Apache-2.0
#include "peers/peers_op.h"

#include "tell_host/tell_host_op.h"

#ifdef BLITZGS_BACKEND_CUDA
namespace blitzgs {
namespace {

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

BLITZGS_REGISTER(m) { m.impl("meet_peers_", TORCH_BOX(&blitzgs::meet_peers)); }
#endif
