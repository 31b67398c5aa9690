// SPDX-License-Identifier: Apache-2.0
// Pinned tensors that kernels write to, checked.
#pragma once
#include "common/op.h"
#include "copy_to_host/copy_to_host.h"

namespace blitzgs {

inline void check_host_values(const char* op, const Tensor& host, std::initializer_list<std::int64_t> shape) {
  check_dtype(op, "host", host, ScalarType::Long);
  check_shape(op, "host", host, shape);
  STD_TORCH_CHECK(host.is_cpu() && host.is_contiguous(), "blitzgs::", op,
                  ": host must be contiguous and in pinned memory of the host");
}

}  // namespace blitzgs
