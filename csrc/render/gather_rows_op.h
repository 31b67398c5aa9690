// SPDX-License-Identifier: Apache-2.0
// Gathers rows of tensors, for all ops that do this.
#pragma once
#include <vector>

#include "common/op.h"
#include "render/gather_rows.h"

namespace blitzgs {

// The rows `ids` of `columns`, and then of `joined`, side by side along their second dimension. ids: int32
// [n], contiguous; known: as in GatherRows.
std::vector<Tensor> gathered_rows(const char* op, const std::vector<Tensor>& columns,
                                  const std::vector<Tensor>& joined, const Tensor& ids,
                                  const std::int64_t* known);

}  // namespace blitzgs
