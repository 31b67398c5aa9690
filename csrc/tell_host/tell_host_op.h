// SPDX-License-Identifier: Apache-2.0
// Pinned tensors that kernels write to, checked.
#pragma once
#include "common/op.h"
#include "tell_host/tell_host.h"

namespace blitzgs {

inline void check_host_values(const char* op, const Tensor& known,
                              std::initializer_list<std::int64_t> shape) {
  check_dtype(op, "known", known, ScalarType::Long);
  check_shape(op, "known", known, shape);
  STD_TORCH_CHECK(known.is_cpu() && known.is_contiguous(), "blitzgs::", op,
                  ": known must be contiguous and in pinned memory of the host");
}

}  // namespace blitzgs
