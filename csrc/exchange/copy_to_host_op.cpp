// SPDX-License-Identifier: Apache-2.0
#include "common/op.h"
#include "exchange/copy_to_host.h"

#ifdef BLITZGS_BACKEND_CUDA
namespace blitzgs {
namespace {

void copy_to_host(Tensor host, const Tensor& values) {
  constexpr const char* kOp = "copy_to_host_";
  check_in_place(kOp, "values", values, ScalarType::Long, {-1});
  STD_TORCH_CHECK(!values.is_cpu(), "blitzgs::", kOp, ": values must be on the GPU");
  check_host_values(kOp, host, {values.size(0)});
  DeviceScope scope(values);
  cuda::copy_to_host(data<std::int64_t>(values), values.size(0), mutable_data<std::int64_t>(host),
                     scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("copy_to_host_", TORCH_BOX(&blitzgs::copy_to_host)); }
#endif
