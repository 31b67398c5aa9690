// SPDX-License-Identifier: Apache-2.0
#include <torch/csrc/stable/ops.h>

#include "common/parallel.h"

namespace blitzgs {

void parallel_for_impl(std::int64_t begin, std::int64_t end, std::int64_t grain, RangeFunction function,
                       void* context) {
  torch::stable::parallel_for(
      begin, end, grain, [function, context](std::int64_t b, std::int64_t e) { function(b, e, context); });
}

int num_threads() { return static_cast<int>(torch::stable::get_num_threads()); }

}  // namespace blitzgs
