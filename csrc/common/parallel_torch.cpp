// SPDX-License-Identifier: Apache-2.0
#include <torch/csrc/stable/ops.h>

#include "common/parallel.h"

namespace blitzgs {

void parallel_for_impl(int64_t begin, int64_t end, int64_t grain, RangeFunction function, void* context) {
  torch::stable::parallel_for(begin, end, grain,
                              [function, context](int64_t b, int64_t e) { function(b, e, context); });
}

int num_threads() { return int(torch::stable::get_num_threads()); }

}  // namespace blitzgs
