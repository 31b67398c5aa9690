// SPDX-License-Identifier: Apache-2.0
#include "adam/position_noise.h"
#include "common/parallel.h"

namespace blitzgs::cpu {

template <class T>
void position_noise(const PositionNoiseArgs<T>& args, Workspace&, CudaStream) {
  parallel_for(0, args.visible, 4096, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t u = begin; u < end; ++u) position_noise_of(args, u);
  });
}

template void position_noise<float>(const PositionNoiseArgs<float>&, Workspace&, CudaStream);
template void position_noise<double>(const PositionNoiseArgs<double>&, Workspace&, CudaStream);

}  // namespace blitzgs::cpu
