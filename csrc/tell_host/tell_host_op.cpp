// SPDX-License-Identifier: Apache-2.0
#include "tell_host/tell_host_op.h"

#ifdef BLITZGS_BACKEND_CUDA
namespace blitzgs {
namespace {

void tell_host(Tensor known, const Tensor& values) {
  constexpr const char* kOp = "tell_host_";
  check_dtype(kOp, "values", values, ScalarType::Long);
  check_shape(kOp, "values", values, {-1});
  STD_TORCH_CHECK(!values.is_cpu() && values.is_contiguous(), "blitzgs::", kOp,
                  ": values must be contiguous and on the GPU");
  check_host_values(kOp, known, {values.size(0)});
  DeviceScope scope(values);
  cuda::tell_host(data<std::int64_t>(values), values.size(0), mutable_data<std::int64_t>(known),
                  scope.stream);
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("tell_host_", TORCH_BOX(&blitzgs::tell_host)); }
#endif
