// SPDX-License-Identifier: Apache-2.0
#include "common/parallel.h"
#include "population/tree_sums.h"

namespace blitzgs::cpu {

void tree_sums(const TreeSumsArgs& args, CudaStream) {
  parallel_for(0, args.n_rows, 256, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t row = begin; row < end; ++row) {
      args.sums[row] = tree_sum_of(args, args.features + row * args.n_features);
    }
  });
}

}  // namespace blitzgs::cpu
