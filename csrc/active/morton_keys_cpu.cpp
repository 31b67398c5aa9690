// SPDX-License-Identifier: Apache-2.0
#include "active/morton_keys.h"

#include "common/parallel.h"
#include "math/morton.h"

namespace blitzgs::cpu {

void morton_keys(const float* points, std::int64_t n, std::int64_t* keys, Workspace&, CudaStream) {
  const MortonFrame frame = morton_frame_of(points, n);
  parallel_for(0, n, 1 << 14, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      keys[i] = static_cast<std::int64_t>(morton_code(points + 3 * i, frame) >> 1);
    }
  });
}

}  // namespace blitzgs::cpu
