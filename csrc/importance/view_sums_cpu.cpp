// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "common/parallel.h"
#include "importance/view_sums.h"

namespace blitzgs::cpu {

void view_sums(const ViewSumsArgs& args, CudaStream) {
  const auto round = [](double value) { return static_cast<std::int64_t>(std::nearbyint(value)); };
  parallel_for(0, args.n_visible, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t u = begin; u < end; ++u) view_sums_of(args, u, round);
  });
}

}  // namespace blitzgs::cpu
