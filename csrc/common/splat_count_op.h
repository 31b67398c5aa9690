// SPDX-License-Identifier: Apache-2.0
// The optional argument n_splats of an op, int64 [1]: how many splats of its columns are valid
// (splat_count.h).
#pragma once
#include <optional>

#include "common/op.h"
#include "common/splat_count.h"

namespace blitzgs {

struct SplatCount {
  std::int64_t n_splats;  // at most
  const std::int64_t*
      known_splats;  // null: all n_splats; otherwise the kernels read it, and the host does not wait
};

inline SplatCount checked_splat_count(const char* op, const std::optional<Tensor>& n_splats,
                                      const Tensor& splats) {
  const std::int64_t room = splats.size(0);
  if (!n_splats) return {room, nullptr};
  check_dtype(op, "n_splats", *n_splats, ScalarType::Long);
  check_shape(op, "n_splats", *n_splats, {1});
  STD_TORCH_CHECK(
      n_splats->is_cpu() == splats.is_cpu() && n_splats->get_device_index() == splats.get_device_index(),
      "blitzgs::", op, ": n_splats must be on the device of the splats");
#ifdef BLITZGS_BACKEND_CUDA
  return {room, data<std::int64_t>(*n_splats)};
#else
  return {splats_there(room, data<std::int64_t>(*n_splats)), nullptr};
#endif
}

}  // namespace blitzgs
