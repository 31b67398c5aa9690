// SPDX-License-Identifier: Apache-2.0
#include "active/morton_keys.h"

#include "common/op.h"

namespace blitzgs {
namespace {

Tensor morton_keys(const Tensor& points) {
  const Tensor rows = checked("morton_keys", "points", points, ScalarType::Float, {-1, 3});
  Tensor keys = make_empty(rows, {rows.size(0)}, ScalarType::Long);
  DeviceScope scope(rows);
  backend::morton_keys(data<float>(rows), rows.size(0), mutable_data<std::int64_t>(keys), scope.workspace,
                       scope.stream);
  return keys;
}

}  // namespace
}  // namespace blitzgs

BLITZGS_REGISTER(m) { m.impl("morton_keys", TORCH_BOX(&blitzgs::morton_keys)); }
